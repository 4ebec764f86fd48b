"""`make wheels`: dora-systemd, and the two libraries of which PyPI has no wheels.

pystemd and systemd-python are compiled, against the libsystemd that every machine with systemd has:
each in a Debian with the Python it is for. uv and pipx find the rest on PyPI. `make arm64` has
those of its Debian compiled in an emulator, for which arm64 stands in the place of a release. In
its place can stand the directory of a Python that no lab has, such as uv's: that is
copied into the oldest Debian.
"""

import hashlib
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from lab import definition
from lab.cache import Layer, ensure, find_cache
from lab.errors import LabError, Stage, say
from lab.foreign import emulated, ensure_foreign_room
from lab.options import FOREIGN
from lab.platforms import COMPILED
from lab.process import need_root

from builder.room import ensure_suite, network_environment, run_in_room
from builder.sources import CHECKOUT, SOURCES, copy_files, list_checkout, read_date, settle

SUITES = (definition.OLD_SUITE, definition.SUITE, definition.NEW_SUITE)
PACKAGES = ("libsystemd-dev", "pkgconf", "python3-dev", "python3-pip", "python3-setuptools")
OUT = CHECKOUT / "dist/wheels"


def main(targets: Sequence[str]) -> int:
    """Build the wheels for these targets, or for the Pythons of the labs; the exit status."""
    try:
        need_root()
        cache = find_cache()
        with tempfile.TemporaryDirectory(prefix="wheels-", dir=cache) as place:
            built = [build_wheels(cache, Path(place), one) for one in targets or SUITES]
            out = OUT.with_name(f"{OUT.name}-{FOREIGN}") if FOREIGN in targets else OUT
            deliver([wheel for one in built for wheel in sorted(one.glob("*.whl"))], out)
    except LabError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def build_wheels(cache: Path, place: Path, target: str) -> Path:
    """The directory with the wheels for the Python of a release of Debian, or for another one."""
    is_other = "/" in target
    room = ensure_wheel_room(cache, definition.OLD_SUITE if is_other else target)
    build = place / Path(target).name
    source = build / "dora-systemd"
    source.mkdir(parents=True)
    copy_files(CHECKOUT, source, list_checkout())
    settle(source, read_date(SOURCES[0]))
    if is_other:
        shutil.copytree(target, build / "python", symlinks=True)
    program = "python/bin/python3" if is_other else "python3"
    emulator = emulated() if target == FOREIGN else nullcontext()
    with emulator, Stage(f"wheels for the Python of {target}"):
        run_pip(room, build, program, ["./dora-systemd"])
        if is_other:
            run_pip(room, build, program, [*COMPILED])
        else:
            shutil.copytree(
                ensure_compiled(cache, room, build), build / OUT.name, dirs_exist_ok=True
            )
    return build / OUT.name


def run_pip(room: Path, build: Path, program: str, what: Sequence[str]) -> None:
    """Build wheels in `room`."""
    command = [program, "-m", "pip", "wheel", "--no-deps", "--no-cache-dir"]
    command += [f"--wheel-dir={OUT.name}", *what]
    run_in_room(room, build, command, network_environment(build), has_network=True)


def ensure_compiled(cache: Path, room: Path, build: Path) -> Path:
    """The wheels of the libraries, which are compiled once in a room: they change with it."""

    def compile_them(path: Path) -> None:
        own = {*(build / OUT.name).iterdir()}
        run_pip(room, build, "python3", [*COMPILED])
        for wheel in {*(build / OUT.name).iterdir()} - own:
            shutil.copy(wheel, path)

    kind = room.name.partition("-")[0].replace("wheelroom", "compiled")
    key = definition.digest(room.name, sorted(COMPILED), definition.read_part(Path(__file__)))
    return ensure(cache, Layer(kind, key, compile_them))


def ensure_wheel_room(cache: Path, suite: str) -> Path:
    """Where the wheels are built; a kind for each release, as the cache keeps two of a kind."""
    kind = f"wheelroom.{suite}"
    if suite == FOREIGN:
        return ensure_foreign_room(cache, kind, PACKAGES)
    return ensure_suite(cache, kind, suite, PACKAGES)


def deliver(wheels: Sequence[Path], out: Path) -> None:
    """Put them where docs/install.md has uv look for them, with a file of checksums."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for wheel in wheels:
        shutil.copy(wheel, out)
    names = sorted(path.name for path in out.iterdir())
    sums = [f"{hashlib.sha256((out / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (out / "SHA256SUMS").write_text("".join(sums), encoding="ascii")
    say(f"{len(names)} wheels, see {out}: {' '.join(names)}")
