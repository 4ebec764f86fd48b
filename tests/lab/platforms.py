"""LAB=bookworm, LAB=forky: another release of Debian, with what the packages need there."""

import re
import shutil
from functools import partial
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import Stage
from lab.image import CERTIFICATES, debian_command, run_in_tree, tree_environment
from lab.process import need_tools, run_logged

# For the tests and for nodes: a user's dataflow has an environment of its own too.
TEST_TOOLS = [
    *(name for name in definition.PYPI if not name.startswith("dora-rs-cli")),
    "websockets>=14",  # for clients of the tests: Debian 12 has none that waits
]
# Of these, PyPI has no wheels: `make wheels` builds them, and they need the others.
COMPILED = {"pystemd": ("lxml", "psutil"), "systemd-python": ()}
# systemd 262 needs /proc to write the journal's catalog.
SETUP = 'mount -t proc proc "$1/proc"; chroot "$1" /bin/sh /run/setup.sh'


def ensure_platform(cache: Path, suite: str) -> Path:
    layer = Layer(suite, platform_key(suite), partial(build, cache=cache, suite=suite))
    return ensure(cache, layer)


def platform_key(suite: str) -> str:
    names = ("platforms.py", "setup.sh")
    sources = [definition.read_part(definition.HERE / name) for name in names]
    return definition.digest(suite, list_packages(suite), list_wheels(), sources)


def list_packages(suite: str) -> list[str]:
    """What the product's package needs, and programs of the tests."""
    return definition.PLATFORM_PACKAGES + definition.TOOLS + definition.PLATFORMS[suite]


def build(path: Path, cache: Path, suite: str) -> None:
    need_tools("mmdebstrap")
    log = cache / f"{suite}.log"
    log.unlink(missing_ok=True)
    path.chmod(0o755)
    packages = list_packages(suite)
    with Stage(f"Debian {suite}, {len(packages)} packages"):
        run_logged(debian_command(path, "minbase", packages, suite), log, "install Debian's")
    with Stage("from PyPI what tests and nodes need"):
        install_from_pypi(path, log)
    with Stage("users and units"):
        set_up(path, log)
    (path / CERTIFICATES).unlink(missing_ok=True)


def install_from_pypi(path: Path, log: Path) -> None:
    run_in_tree(path, ["python3", "-m", "venv", "--system-site-packages", "/opt/lab"], log)
    run_in_tree(path, ["pip", "install", "--no-cache-dir", *TEST_TOOLS], log)
    # There is no network inside, where uv installs the product.
    only = ["--only-binary=:all:", "--no-cache-dir", "--dest=/opt/wheels"]
    run_in_tree(path, ["pip", "download", *only, *list_wheels()], log)


def set_up(path: Path, log: Path) -> None:
    shutil.copy(definition.HERE / "setup.sh", path / "run/setup.sh")
    # The mount ends with its namespace.
    command = ["unshare", "--mount", "sh", "-euc", SETUP, "sh", str(path)]
    run_logged(command, log, "set up users and units", env=tree_environment(path))


def list_wheels() -> list[str]:
    """What uv finds on PyPI when it installs the product, and dora's command."""
    found = {re.split("[<>=]", one)[0]: one for one in definition.read_dependencies()}
    more = [name for names in COMPILED.values() for name in names]
    return [
        definition.PYPI[0],
        *(one for name, one in found.items() if name not in COMPILED),
        *more,
    ]
