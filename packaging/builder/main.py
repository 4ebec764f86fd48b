"""`make deb`: both packages, built twice, compared, looked at by lintian, and put into dist/."""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure, find_cache
from lab.errors import LabError, Stage, say
from lab.process import need_root

from builder.compare import compare_builds, describe
from builder.room import build_dependencies, ensure_room, run_in_room
from builder.sources import CHECKOUT, SOURCES, Source, ensure_wheels, list_checkout, stage

HERE = Path(__file__).resolve().parent
# Two builds of the same source that have nothing else in common.
VARIATIONS = (
    {"TZ": "UTC", "LANG": "C.UTF-8"},
    {"TZ": "Pacific/Kiritimati", "LANG": "C", "DEB_BUILD_OPTIONS": "parallel=1"},
)
UMASKS = ("0022", "0002")
# Beside this: what makes no packages.
NO_PACKAGES = ("wheels.py", "autopkgtest.py", "autopkgtest.sh")
# This check compares each line with the modules that Python has removed, and takes nine tenths of
# lintian's time. The unit tests import all our modules with Python 3.13.
NOT_CHECKED = "languages/python/stdlib-deprecation"
LINTIAN = (
    *("lintian", "--allow-root", "--fail-on=error,warning", "--tag-display-limit=0"),
    f"--dont-check-part={NOT_CHECKED}",
)


def main(arguments: Sequence[str]) -> int:
    """Build what is asked for; the exit status."""
    options = parse(arguments)
    started = time.monotonic()
    try:
        need_root()
        cache = find_cache()
        with tempfile.TemporaryDirectory(prefix="build-", dir=cache) as place:
            built = build_all(cache, Path(place), options.once)
            deliver(built, options.out)
    except LabError as error:
        print(error, file=sys.stderr)
        return 1
    say(f"{len(built)} packages in {time.monotonic() - started:.0f} s, see {options.out}")
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The command line as a value."""
    parser = argparse.ArgumentParser(
        prog="packaging/build", description="Build the Debian packages in a clean Debian 13."
    )
    parser.add_argument("--once", action="store_true", help="do not build a second time to compare")
    parser.add_argument("--out", type=Path, default=CHECKOUT / "dist", help="default: dist/")
    return parser.parse_args(arguments)


def build_all(cache: Path, place: Path, is_once: bool) -> list[Path]:
    """All packages, somewhere below `place`."""
    controls = [source.debian / "control" for source in SOURCES]
    room = ensure_room(cache, build_dependencies(*controls))
    wheels = ensure_wheels(cache, room)
    own, dora = SOURCES

    def build_dora(path: Path) -> None:
        for package in build_source(dora, place, room, wheels, is_once):
            shutil.copy(package, path)

    kept = ensure(cache, Layer("dora-packages", dora_key(dora, room, is_once), build_dora))
    return [*build_source(own, place, room, wheels, is_once), *sorted(kept.glob("*.deb"))]


def dora_key(source: Source, room: Path, is_once: bool) -> str:
    """What the packages of dora's command are made of: it changes with dora's versions only."""
    debian, builder = source.debian.relative_to(CHECKOUT), HERE.relative_to(CHECKOUT)
    files = [path for path in list_checkout() if {debian, builder} & {*path.parents}]
    files = [path for path in files if path.name not in NO_PACKAGES]
    parts = [(str(path), definition.read_part(CHECKOUT / path)) for path in files]
    return definition.digest(parts, room.name, is_once)


def build_source(
    source: Source, place: Path, room: Path, wheels: Path, is_once: bool
) -> list[Path]:
    """Build one source package, with all that must hold for it."""
    staged = place / source.name
    staged.mkdir()
    tree = stage(source, staged, wheels)  # once: somebody may be editing
    first = build(source, tree, place / f"{source.name}-first", room, 0)
    with Stage(f"lintian {source.name}"):
        for changes in sorted(first.glob("*.changes")):
            run_in_room(room, first, [*LINTIAN, changes.name])
    if not is_once:
        second = build(source, tree, place / f"{source.name}-second-and-longer", room, 1)
        compare_builds(first, second)
    return sorted(first.glob("*.deb"))


def build(source: Source, tree: Path, place: Path, room: Path, variation: int) -> Path:
    """One build of the staged source, in a directory of its own."""
    shutil.copytree(tree.parent, place)
    with Stage(f"build {source.name}, {'first' if not variation else 'second'} time"):
        for command in commands(source):
            script = f'umask {UMASKS[variation]}; cd "$1"; shift; exec "$@"'
            words = ["sh", "-c", script, "sh", tree.name, *command]
            run_in_room(room, place, words, VARIATIONS[variation])
    return place


def commands(source: Source) -> Iterator[list[str]]:
    """One run of dpkg-buildpackage, or one for each architecture."""
    program = ["dpkg-buildpackage", "--no-sign"]
    if not source.architectures:
        yield program
        return
    yield [*program, "--build=source"]
    for architecture in source.architectures:
        # Nothing is compiled: another architecture needs no compiler and none of its libraries.
        yield [*program, "--build=any", f"--host-arch={architecture}", "--no-check-builddeps"]


def deliver(packages: Sequence[Path], out: Path) -> None:
    """Put them where they are looked for, instead of those of an earlier build."""
    out.mkdir(parents=True, exist_ok=True)
    for name in ("dora-systemd", "dora-cli"):
        for old in out.glob(f"{name}_*.deb"):
            old.unlink()
    for package in packages:
        shutil.copy(package, out)
        say(describe(package))
