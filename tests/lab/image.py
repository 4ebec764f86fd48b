"""The Debian tree: packages, the venv with dora, and the checkout as an editable install."""

import os
import shutil
import subprocess
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import LabError, Stage
from lab.process import die_with_parent, need_tools, run_logged

CLEAN_PATH = "/opt/lab/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
# Inside the tree while it is built; /run is a tmpfs once it is booted.
CERTIFICATES = "run/lab-certificates.pem"
DIFFERENCE = "var/lib/lab/difference.tar"
FINDER = """\
import sys
class Checkout:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name in ("dora_systemd", "dora_systemd.cli"):
            from importlib.machinery import PathFinder
            return PathFinder.find_spec(name, ["/src"])
sys.meta_path.append(Checkout)
"""


def ensure_tree(cache: Path) -> Path:
    return ensure(cache, tree_layer(cache))


def base_layer(cache: Path) -> Layer:
    return Layer("base", definition.base_key(), lambda path: build_base(path, cache / "base.log"))


def tree_layer(cache: Path) -> Layer:
    return Layer("tree", definition.tree_key(), lambda path: build_tree(path, cache))


def build_base(path: Path, log: Path) -> None:
    need_tools("mmdebstrap")
    log.unlink(missing_ok=True)
    path.chmod(0o755)
    with Stage(f"Debian {definition.SUITE}, {len(definition.PACKAGES)} packages"):
        command = debian_command(path, "minbase", definition.PACKAGES)
        run_logged(command, log, "install Debian's packages")
    with Stage("dora and test tools from PyPI"):
        run_in_tree(path, ["python3", "-m", "venv", "--system-site-packages", "/opt/lab"], log)
        run_in_tree(path, ["pip", "install", "--no-cache-dir", *definition.PYPI], log)
        apart = ["--no-deps", f"--target={definition.NUMPY}"]
        run_in_tree(path, ["pip", "install", "--no-cache-dir", *apart, "numpy"], log)
        run_in_tree(path, ["pip", "uninstall", "--yes", *definition.UNUSED], log)
    with Stage("users and units"):
        shutil.copy(definition.HERE / "setup.sh", path / "run/setup.sh")
        run_in_tree(path, ["sh", "/run/setup.sh"], log)


def debian_command(
    path: Path, variant: str, packages: list[str], suite: str = definition.SUITE, *options: str
) -> list[str]:
    mirror = os.environ.get("LAB_MIRROR")
    # A mirror that is not updated any more has it expire, in a suite that is not released.
    expired = ["--aptopt=Acquire::Check-Valid-Until false"] if suite == definition.NEW_SUITE else []
    # It mounts file systems below `path`, and starts apt: neither outlives a lab that is killed.
    alone = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
    return [
        *die_with_parent(alone),
        "mmdebstrap", f"--variant={variant}", "--mode=root", "--format=directory",
        f"--include={','.join(packages)}",
        "--dpkgopt=path-exclude=/usr/share/doc/*",
        "--dpkgopt=path-exclude=/usr/share/locale/*",
        *expired, *options, suite, str(path), *([mirror] if mirror else []),
    ]  # fmt: skip


def unpacked_layer(
    cache: Path, kind: str, packages: list[str], suite: str = definition.SUITE
) -> Layer:
    """The files of Debian packages, which are not installed."""

    def build(path: Path) -> None:
        with Stage(f"{kind}: {', '.join(packages)} of Debian {suite}"):
            command = debian_command(path, "extract", packages, suite)
            run_logged(command, cache / f"{kind}.log", f"download {packages[0]}")

    return Layer(kind, definition.digest(suite, packages), build)


def build_tree(path: Path, cache: Path) -> None:
    """A copy of the base by hard links: pip and useradd replace files, they do not rewrite them."""
    base = ensure(cache, base_layer(cache))
    log = cache / "tree.log"
    with Stage("editable install of the checkout"):
        path.rmdir()
        run_logged(["cp", "--archive", "--link", str(base), str(path)], log, "copy the base")
        add_dora_user(path, log)
        install_checkout(path, log)
        write_difference(path, log)


def add_dora_user(path: Path, log: Path) -> None:
    if definition.SYSUSERS.is_file():
        shutil.copy(definition.SYSUSERS, path / "run/dora.conf")
        run_in_tree(path, ["systemd-sysusers", "/run/dora.conf"], log)
    if "dora:" not in (path / "etc/passwd").read_text(encoding="utf-8"):
        run_in_tree(path, ["useradd", "--system", "--user-group", "dora"], log)


def install_checkout(path: Path, log: Path) -> None:
    source = path / "src"
    source.mkdir()
    copy_checkout(source)
    # No isolation and no dependencies: the build must not need the network, and Debian's are used.
    options = ["--no-deps", "--no-build-isolation", "--quiet"]
    run_in_tree(path, ["pip", "install", *options, "--editable", "/src"], log)
    replace_finder(path)
    shutil.rmtree(source)
    source.mkdir()


def replace_finder(path: Path) -> None:
    """Every Python loads the finder that pip has written: ten times slower than this one."""
    (packages,) = path.glob("opt/lab/lib/python3*/site-packages")
    for old in packages.glob("__editable__*"):
        old.unlink() if old.is_file() else shutil.rmtree(old)
    (packages / "lab_checkout.py").write_text(FINDER, encoding="ascii")
    (packages / "lab_checkout.pth").write_text("import lab_checkout\n", encoding="ascii")


def write_difference(path: Path, log: Path) -> None:
    """What is not a link into the base: all that the machine, made of the base, lacks."""
    (path / DIFFERENCE).parent.mkdir()
    script = 'cd "$1" && find . -type f -links 1 -print0 | tar -cf "$2" --null --files-from=-'
    command = ["sh", "-c", script, "sh", str(path), str(path / DIFFERENCE)]
    run_logged(command, log, "list what is new in the tree")


def copy_checkout(target: Path) -> None:
    with subprocess.Popen(pack_command(definition.CHECKOUT), stdout=subprocess.PIPE) as pack:
        unpack = ["tar", "--extract", "--directory", str(target)]
        subprocess.run(unpack, stdin=pack.stdout, check=True)
    check_packed(pack.returncode)


def check_packed(status: int) -> None:
    """1 = a file changed or vanished meanwhile: someone is editing, that is no error."""
    if status not in (0, 1):
        raise LabError(f"copy the checkout {definition.CHECKOUT}", "is all of it readable?")


def pack_command(checkout: Path, *options: str) -> list[str]:
    """Owned by root, or git inside would refuse it; readable for alice whatever the umask was."""
    junk = ("__pycache__", ".*_cache", ".hypothesis", ".venv", "*.egg-info")
    return [
        "tar", "--create", "--directory", str(checkout), "--owner=0", "--group=0", "--mode=a+rX",
        "--warning=none", *options, *(f"--exclude={name}" for name in junk), ".",
    ]  # fmt: skip


def run_in_tree(path: Path, command: list[str], log: Path) -> None:
    chroot = ["chroot", str(path), "/usr/bin/env", *command]
    run_logged(chroot, log, f"run {command[0]} in the new tree", env=tree_environment(path))


def tree_environment(path: Path) -> dict[str, str]:
    """Only what pip needs: paths of the host (REQUESTS_CA_BUNDLE) would break it inside."""
    wanted = {"http_proxy", "https_proxy", "no_proxy", "pip_index_url", "pip_extra_index_url"}
    env = {name: value for name, value in os.environ.items() if name.lower() in wanted}
    certificates = os.environ.get("PIP_CERT") or os.environ.get("SSL_CERT_FILE")
    if certificates and Path(certificates).is_file():
        shutil.copy(certificates, path / CERTIFICATES)
        env["PIP_CERT"] = f"/{CERTIFICATES}"
    return env | {"PATH": CLEAN_PATH, "LANG": "C.UTF-8", "HOME": "/root"}
