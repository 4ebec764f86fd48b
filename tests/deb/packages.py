"""The Debian packages as a user of them meets them: installed, without this lab's dora."""

import os
import pwd
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.lab.pace import bound
from tests.system.cells import run

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = ("dora-systemd", "dora-cli")
PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
AUTOPKGTEST = "AUTOPKGTEST_TMP" in os.environ
"""There the packages come from a repository, and so are installed already."""
ROBOT = CHECKOUT / "examples/robot"
_LAB_MODULES = ("opt/lab/lib/python3*/site-packages", "opt/numpy")
_LIBRARIES = ("dora-rs==1.1.0", "pyarrow", "numpy")

_WATCHED = ("/etc", "/usr", "/var", "/opt", "/run/dora-systemd")
# What dpkg, apt, man and Python note for themselves, and the journal.
_NOT_OURS = ("/var/lib/dpkg", "/var/lib/apt", "/var/cache", "/var/log", "/var/tmp", "/usr/local")


def find_packages() -> list[Path]:
    """The .deb files of this machine: those of `make deb`, unless DORA_DEBS names others."""
    place = Path(os.environ.get("DORA_DEBS", CHECKOUT / "dist"))
    if AUTOPKGTEST:
        place = Path(os.environ["AUTOPKGTEST_TMP"])
        run("apt-get", "download", *PACKAGES, cwd=place)
    own = run("dpkg", "--print-architecture").stdout.strip()
    found = [path for kind in ("all", own) for path in sorted(place.glob(f"dora-*_{kind}.deb"))]
    assert len(found) == len(PACKAGES), f"no packages in {place}: run make deb"
    return found


def build_previous(place: Path, edits: Mapping[str, tuple[str, str]] = {}) -> list[Path]:
    """The same packages as an earlier build would be, below `place`.

    edits: a text and another one for it, by module of the product.
    """
    built = place / "previous"
    built.mkdir()
    for path in find_packages():
        tree = place / path.stem
        run("dpkg-deb", "--raw-extract", str(path), str(tree))
        control = tree / "DEBIAN/control"
        text = control.read_text()
        control.write_text(re.sub(r"^(Version: .*)$", r"\1~previous", text, flags=re.MULTILINE))
        for module in tree.glob("usr/lib/python3/dist-packages/dora_systemd/__init__.py"):
            code = module.read_text()
            module.write_text(re.sub(r'(__version__ = "[^"]+)', r"\1~previous", code))
        for name, (text, other) in edits.items():
            for module in tree.glob(f"usr/lib/python3/dist-packages/dora_systemd/{name}"):
                assert text in module.read_text()
                module.write_text(module.read_text().replace(text, other))
        run("dpkg-deb", "--root-owner-group", "-Znone", "--build", str(tree), str(built))
    return sorted(built.iterdir())


def install(paths: Sequence[Path] = ()) -> None:
    """Install these packages, or those of this build, as a user does; there or not there."""
    if not AUTOPKGTEST:  # Debian's index of manuals takes longer than the rest
        Path("/var/lib/man-db/auto-update").unlink(missing_ok=True)
    options = ("--yes", "--reinstall", "--allow-downgrades", "-o", "Dpkg::Use-Pty=0")
    apt("install", *options, *map(str, paths or find_packages()))


def version() -> str:
    """That of the package dora-systemd which is installed."""
    return sh("dpkg-query -Wf '${Version}' dora-systemd").stdout


def apt(*arguments: str) -> None:
    """apt-get, asking nothing; in a machine it takes its minutes."""
    environment = {**os.environ, "PATH": PATH, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        ["apt-get", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=bound(900),
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def caller(user: str) -> tuple[str, ...]:
    """The words before a command of `user`, who has nothing but what Debian gives him."""
    home = pwd.getpwnam(user).pw_dir
    plain = ("env", "--ignore-environment", "--chdir=/", f"PATH={PATH}", "LANG=C.UTF-8")
    switch = ("setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups")
    return (*plain, f"HOME={home}", *(() if user == "root" else switch))


def sh(script: str, user: str = "root", check: bool = True) -> subprocess.CompletedProcess[str]:
    """A shell script as `user`."""
    return run(*caller(user), "sh", "-euc", script, check=check)


@contextmanager
def robot(user: str) -> Iterator[Path]:
    """The example as `user` has it, with a virtual environment beside it that has no dora."""
    place = Path(tempfile.mkdtemp(prefix=f"robot-{user}-", dir="/var/tmp"))
    shutil.copytree(ROBOT, place, dirs_exist_ok=True)
    make_venv(place / ".venv")
    run("chmod", "--recursive", "a+rX", str(place))
    run("chown", "--recursive", f"{user}:", str(place))
    yield place / "dataflow.yml"
    shutil.rmtree(place)


def make_venv(venv: Path) -> None:
    """With what the nodes need: that of the lab, elsewhere from PyPI."""
    modules = [str(path) for place in _LAB_MODULES for path in Path("/").glob(place)]
    run("python3", "-m", "venv", *(["--without-pip"] if modules else []), str(venv))
    if modules:
        (library,) = venv.glob("lib/python3*/site-packages")
        (library / "lab.pth").write_text("\n".join(modules))
    else:
        run(f"{venv}/bin/pip", "install", "--quiet", *_LIBRARIES)


def files() -> set[str]:
    """Everything on the disk that a package could have left there."""
    skipped = [word for path in _NOT_OURS for word in ("-path", path, "-prune", "-o")]
    found = run("find", *_WATCHED, *skipped, "-print", check=False).stdout.splitlines()
    # useradd and its like keep a copy of what was before.
    return {path for path in found if not path.endswith(("-", "/.pwd.lock")) and path}


def listeners() -> set[str]:
    """The addresses that somebody listens on."""
    lines = run("ss", "-Hltun").stdout.splitlines()
    return {line.split()[4] for line in lines}


def services() -> set[str]:
    """The services that run."""
    command = ("systemctl", "list-units", "--plain", "--no-legend", "--state=running", "*.service")
    return {line.split()[0] for line in run(*command).stdout.splitlines()}
