"""LAB=arm64: a container with Debian for another processor, whose programs QEMU runs, one by one.

The kernel is this machine's. It starts QEMU for each program of arm64 as long as QEMU is registered
with it. QEMU lacks system calls by which systemd makes mount namespaces: there services have no
sandbox, and get no credentials.
"""

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure, find_cache
from lab.container import run_in_container
from lab.errors import LabError, Stage
from lab.image import CERTIFICATES, debian_command, unpacked_layer
from lab.options import FOREIGN, Options
from lab.platforms import install_from_pypi, list_wheels, set_up
from lab.process import need_tools, run_logged
from lab.runs import Run

PACKAGES = definition.PLATFORM_PACKAGES
ENTRIES = Path("/proc/sys/fs/binfmt_misc")
# The first bytes of a program of arm64, and which bits of them count; see binfmt_misc in the
# kernel's documentation. F: the kernel opens QEMU now, so that it need not be in the tree.
MAGIC = r"\x7fELF\x02\x01\x01" + r"\x00" * 9 + r"\x02\x00\xb7\x00"
MASK = r"\xff" * 7 + r"\x00" + r"\xff" * 8 + r"\xfe\xff\xff\xff"
FLAGS = "OCF"
# In a mount namespace of its own. The kernel forgets entries with the last mount of this, and this
# process ends with the one that reads its output. $1 is the name of the entry, $2 the entry.
REGISTER = f"""
mount -t binfmt_misc binfmt_misc {ENTRIES}
printf %s "$2" >{ENTRIES}/register
echo
read -r end || :
echo -1 >{ENTRIES}/"$1"
"""
DROP_IN = "[Service]\nImportCredential=\nLoadCredential=\n"


def run_in_foreign(run: Run, tree: Path, options: Options) -> int:
    with emulated():
        return run_in_container(run, tree, options)


@contextmanager
def emulated() -> Iterator[None]:
    """Programs of arm64 run meanwhile."""
    cache = find_cache()
    layer = ensure(cache, unpacked_layer(cache, "qemu-user", ["qemu-user"]))
    name = f"dora-lab-{os.getpid()}"
    entry = f":{name}:M::{MAGIC}:{MASK}:{layer / 'usr/bin/qemu-aarch64'}:{FLAGS}"
    command = ["unshare", "--mount", "sh", "-euc", REGISTER, "sh", name, entry]
    pipe = subprocess.PIPE
    # Ctrl+C is for the command.
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, start_new_session=True) as keeper:
        assert keeper.stdin and keeper.stdout
        if not keeper.stdout.readline():
            hint = "needs root and a kernel with binfmt_misc: modprobe binfmt_misc"
            raise LabError(f"run programs of {FOREIGN}", hint)
        try:
            yield
        finally:
            keeper.stdin.close()


def ensure_foreign(cache: Path) -> Path:
    """The tree of LAB=arm64."""
    names = ("platforms.py", "setup.sh")
    sources = [definition.read_part(definition.HERE / name) for name in names]
    key = definition.digest(definition.SUITE, PACKAGES, list_wheels(), sources, DROP_IN)
    return ensure(cache, Layer(FOREIGN, key, lambda path: build(path, cache)))


def build(path: Path, cache: Path) -> None:
    log = cache / f"{FOREIGN}.log"
    log.unlink(missing_ok=True)
    path.chmod(0o755)
    with emulated():
        install_debian(path, "minbase", PACKAGES, log)
        with Stage("from PyPI what tests and nodes need"):
            install_from_pypi(path, log)
        with Stage("users and units"):
            set_up(path, log)
    (path / CERTIFICATES).unlink(missing_ok=True)
    drop_in = path / "etc/systemd/system/service.d/lab.conf"
    drop_in.parent.mkdir(parents=True)
    drop_in.write_text(DROP_IN, encoding="ascii")


def ensure_foreign_room(cache: Path, kind: str, packages: Sequence[str]) -> Path:
    """A tree in which packages for the other processor are built."""

    def build(path: Path) -> None:
        with emulated():
            install_debian(path, "buildd", packages, cache / f"{kind}.log")

    key = definition.digest(definition.SUITE, packages)
    return ensure(cache, Layer(kind, key, build))


def install_debian(path: Path, variant: str, packages: Sequence[str], log: Path) -> None:
    need_tools("mmdebstrap")
    more = f"--architectures={FOREIGN}", "--skip=check/qemu"
    command = debian_command(path, variant, list(packages), definition.SUITE, *more)
    with Stage(f"Debian {definition.SUITE} for {FOREIGN}, {len(packages)} packages"):
        run_logged(command, log, "install Debian's packages")
