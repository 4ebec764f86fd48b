"""`make autopkgtest`: debian/tests, run by Debian's own program for that in a booted Debian 13.

The lab has no network: what it lacks is downloaded first, for exactly the packages that it has.
"""

import shutil
import subprocess
import sys

from lab.cache import find_cache
from lab.errors import LabError, Stage
from lab.image import ensure_tree
from lab.process import need_root

from builder.room import run_in_room
from builder.sources import CHECKOUT

PACKAGES = ("autopkgtest", "dpkg-dev", "python3-pytest")
# Below dist/, which the lab gets with the checkout.
PLACE = CHECKOUT / "dist/autopkgtest"
DOWNLOAD = """
apt-get --quiet update
apt-get -o APT::Sandbox::User=root -o Dir::Cache::archives=/build --yes --download-only \
    --no-install-recommends install "$@"
rm -rf partial lock
"""


def main() -> int:
    """The exit status of autopkgtest, or 1."""
    lab = [str(CHECKOUT / "tests/lab/lab"), "run", "--"]
    command = [*lab, "sh", "packaging/builder/autopkgtest.sh"]
    try:
        need_root()
        download()
        return subprocess.run(command, check=False).returncode
    except LabError as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        shutil.rmtree(PLACE, ignore_errors=True)


def download() -> None:
    """Put into PLACE what autopkgtest needs and the lab's image has not."""
    tree = ensure_tree(find_cache())
    PLACE.mkdir(parents=True, exist_ok=True)
    with Stage("autopkgtest from Debian"):
        run_in_room(tree, PLACE, ["sh", "-euc", DOWNLOAD, "sh", *PACKAGES], has_network=True)
