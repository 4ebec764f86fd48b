"""The source trees of the packages, made from the checkout with fixed modes and times."""

import os
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure
from lab.errors import LabError, Stage

from builder.room import network_environment, run_in_room

CHECKOUT = definition.CHECKOUT
PACKAGING = CHECKOUT / "packaging"
WHEELS = PACKAGING / "dora-cli/debian/SHA256SUMS"


@dataclass(frozen=True)
class Wheel:
    """One line of SHA256SUMS, which pins what dora's project has published."""

    sha256: str
    file: str

    @property
    def platform(self) -> str:
        """The tag that pip knows it by."""
        return self.file.removesuffix(".whl").rpartition("-")[2]


@dataclass(frozen=True)
class Source:
    """One source package: where its debian/ is, and for which architectures it is built.

    architectures: beside that of this machine, on which the others are built too.
    """

    name: str
    debian: Path
    architectures: tuple[str, ...] = ()


SOURCES = (
    Source("dora-systemd", PACKAGING / "debian"),
    Source("dora-cli", PACKAGING / "dora-cli/debian", ("amd64", "arm64")),
)


def read_wheels() -> list[Wheel]:
    """The wheels of the dora command, one for each architecture."""
    return [Wheel(*line.split()) for line in WHEELS.read_text(encoding="ascii").splitlines()]


def read_changelog(source: Source) -> str:
    """The version of a source package, as in "1.1.0-1"."""
    first = (source.debian / "changelog").read_text(encoding="utf-8").partition("\n")[0]
    return first.partition("(")[2].partition(")")[0]


def read_date(source: Source) -> float:
    """When the newest version was made, the same as SOURCE_DATE_EPOCH of its build."""
    lines = (source.debian / "changelog").read_text(encoding="utf-8").splitlines()
    last = next(line for line in lines if line.startswith(" -- "))
    return parsedate_to_datetime(last.partition("  ")[2]).timestamp()


def stage(source: Source, place: Path, wheels: Path) -> Path:
    """The unpacked source package below `place`, and what it needs beside it."""
    version = read_changelog(source)
    tree = place / f"{source.name}-{version.rpartition('-')[0] or version}"
    tree.mkdir()
    date = read_date(source)
    if source.name == "dora-systemd":
        copy_files(CHECKOUT, tree, list_checkout())
        shutil.rmtree(tree / "packaging/debian")
    else:
        copy_files(wheels, tree, sorted(path.name for path in wheels.glob("*.whl")))
    debian = source.debian.relative_to(CHECKOUT)
    names = [path.relative_to(debian) for path in list_checkout() if path.is_relative_to(debian)]
    if source.name != "dora-systemd":
        settle(tree, date)
        pack_original(tree, version)
    copy_files(source.debian, tree / "debian", names)
    settle(tree, date)
    return tree


def list_checkout() -> list[Path]:
    """What git has or would take: nothing that a build or an editor left behind."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(f"list the checkout: {done.stderr}", "it must be a git checkout")
    names = sorted(set(filter(None, done.stdout.split("\0"))))
    return [Path(name) for name in names if (CHECKOUT / name).is_file()]


def copy_files(origin: Path, target: Path, names: Iterable[Path | str]) -> None:
    """Copies of some files of a directory."""
    for name in names:
        path = target / name
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(origin / name, path)


def settle(tree: Path, date: float) -> None:
    """Modes and times that do not depend on who made the checkout, and when."""
    for path in [tree, *tree.rglob("*")]:
        is_program = path.is_dir() or path.stat().st_mode & 0o100
        path.chmod(0o755 if is_program else 0o644)
        os.utime(path, (date, date))


def pack_original(tree: Path, version: str) -> None:
    """The upstream tarball: wheels are packed already, so this packs no further."""
    name = f"{tree.name.rpartition('-')[0]}_{version.rpartition('-')[0]}.orig.tar.gz"
    script = 'tar --create --sort=name --owner=0 --group=0 --numeric-owner --format=ustar "$1"'
    command = ["sh", "-c", f'{script} | gzip --no-name -1 >"$2"', "sh", tree.name, name]
    subprocess.run(command, cwd=tree.parent, check=True)


def ensure_wheels(cache: Path, room: Path) -> Path:
    """The directory with the wheels, fetched once and checked."""
    text = WHEELS.read_text(encoding="ascii")
    key = definition.digest(text)
    return ensure(cache, Layer("wheels", key, lambda path: fetch_wheels(path, room)))


def fetch_wheels(path: Path, room: Path) -> None:
    """pip refuses what has another checksum than SHA256SUMS says."""
    version = read_changelog(SOURCES[1]).partition("-")[0]
    options = ["--no-deps", "--only-binary=:all:", "--require-hashes", "--no-cache-dir"]
    for wheel in read_wheels():
        with Stage(f"{wheel.file} from PyPI"):
            line = f"dora-rs-cli=={version} --hash=sha256:{wheel.sha256}\n"
            (path / "requirements.txt").write_text(line, encoding="ascii")
            target = ["--platform", wheel.platform, "--python-version", "311", "--abi", "abi3"]
            command = ["pip", "download", *options, *target, "--requirement=requirements.txt"]
            run_in_room(room, path, command, network_environment(path), has_network=True)
    for name in ("requirements.txt", "certificates.pem"):
        (path / name).unlink(missing_ok=True)
