"""The clean Debian that packages are built in: a tree from the lab's cache, written to by nobody.

Each command has a fresh, empty layer over it, processes of its own and no network.
"""

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import LabError, Stage
from lab.image import debian_command
from lab.process import need_tools, read_last_line, run_logged

# Nothing of the host's own environment gets in, so that it cannot get into a package.
ENVIRONMENT = {
    "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
    "LANG": "C.UTF-8",
    "HOME": "/nonexistent",
    "DEB_BUILD_OPTIONS": "parallel=2",
}
TOOLS = ("lintian", "python3-pip")
NETWORK = ("http_proxy", "https_proxy", "no_proxy", "pip_index_url", "pip_extra_index_url")

# $1: the tree, $2: an empty directory, $3: what is /build inside; then the command.
SCRIPT = """
tree=$1 place=$2 build=$3; shift 3
mount -t tmpfs tmpfs "$place"
mkdir "$place/new" "$place/work" "$place/root"
mount -t overlay -o "lowerdir=$tree,upperdir=$place/new,workdir=$place/work" room "$place/root"
mkdir "$place/root/build"
mount --bind "$build" "$place/root/build"
mount -t proc proc "$place/root/proc"
cp --dereference /etc/resolv.conf "$place/root/etc/"
exec chroot "$place/root" /usr/bin/env --chdir=/build -i "$@"
"""


def build_dependencies(*controls: Path) -> list[str]:
    """The packages that Build-Depends of some debian/control name, without versions."""
    names = set()
    for control in controls:
        text = control.read_text(encoding="utf-8").replace("\n ", " ")
        lines = [line for line in text.splitlines() if line.startswith("Build-Depends")]
        words = ",".join(line.partition(":")[2] for line in lines).split(",")
        names |= {word.split()[0].partition(":")[0] for word in words if word.strip()}
    # A virtual package that mmdebstrap cannot choose for us; debhelper provides it.
    return sorted(name for name in names if name != "debhelper-compat")


def ensure_room(cache: Path, packages: Sequence[str]) -> Path:
    """The tree with these packages, built if it is not there."""
    return ensure_suite(cache, "room", definition.SUITE, sorted({*packages, *TOOLS, "debhelper"}))


def ensure_suite(cache: Path, kind: str, suite: str, packages: Sequence[str]) -> Path:
    """The tree of a release of Debian with these packages, built if it is not there.

    kind: of the layer; the cache keeps two of each.
    """
    key = definition.digest(suite, packages)
    return ensure(cache, Layer(kind, key, lambda path: build_room(path, suite, packages, cache)))


def build_room(path: Path, suite: str, packages: Sequence[str], cache: Path) -> None:
    """A Debian with build-essential and `packages`."""
    need_tools("mmdebstrap")
    with Stage(f"Debian {suite} to build in, {len(packages)} packages"):
        command = debian_command(path, "buildd", list(packages), suite)
        run_logged(command, cache / "room.log", "make the tree to build in")


def run_in_room(
    room: Path,
    build: Path,
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    has_network: bool = False,
) -> None:
    """Run a command in a fresh room whose /build is `build`; raises LabError if it fails."""
    place = build.with_name(f"{build.name}.room")
    place.mkdir(exist_ok=True)
    variables = [f"{key}={text}" for key, text in {**ENVIRONMENT, **(environment or {})}.items()]
    network = [] if has_network else ["--net"]
    unshare = ["unshare", "--mount", "--ipc", "--uts", *network, "--pid", "--fork", "--kill-child"]
    words = ["sh", "-euc", SCRIPT, "sh", str(room), str(place), str(build)]
    log = build.with_name(f"{build.name}.log")
    try:
        run_logged([*unshare, *words, *variables, *command], log, f"run {command[0]}")
    except LabError:
        raise LabError(f"run {command[0]}: {read_last_line(log)}", f"see {keep_log(log)}") from None
    finally:
        place.rmdir()


def keep_log(log: Path) -> Path:
    """The directory of a build goes; its log must not, if it failed."""
    return Path(shutil.copy(log, "/var/tmp/dora-systemd-build.log"))


def network_environment(build: Path) -> dict[str, str]:
    """What pip needs of the host to reach an index: certificates and proxies."""
    env = {name: text for name, text in os.environ.items() if name.lower() in NETWORK}
    certificates = os.environ.get("PIP_CERT") or os.environ.get("SSL_CERT_FILE")
    if certificates and Path(certificates).is_file():
        shutil.copy(certificates, build / "certificates.pem")
        env["PIP_CERT"] = "/build/certificates.pem"
    return env
