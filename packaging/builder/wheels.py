"""`make wheels`: dora-systemd, and the two libraries of which PyPI has no wheels.

pystemd and systemd-python are compiled, against the libsystemd that every machine with systemd has:
each in a Debian with the Python it is for. uv and pipx find the rest on PyPI.
"""

import hashlib
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from lab import definition
from lab.cache import find_cache
from lab.errors import LabError, Stage, say
from lab.platforms import COMPILED
from lab.process import need_root

from builder.room import ensure_suite, network_environment, run_in_room
from builder.sources import CHECKOUT, SOURCES, copy_files, list_checkout, read_date, settle

SUITES = (definition.OLD_SUITE, definition.SUITE, definition.NEW_SUITE)
PACKAGES = ("libsystemd-dev", "pkgconf", "python3-dev", "python3-pip", "python3-setuptools")
OUT = CHECKOUT / "dist/wheels"


def main(suites: Sequence[str]) -> int:
    """Build the wheels in these releases of Debian, or in those of the labs; the exit status."""
    try:
        need_root()
        cache = find_cache()
        with tempfile.TemporaryDirectory(prefix="wheels-", dir=cache) as place:
            built = [build_wheels(cache, Path(place), suite) for suite in suites or SUITES]
            deliver([wheel for one in built for wheel in sorted(one.glob("*.whl"))])
    except LabError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def build_wheels(cache: Path, place: Path, suite: str) -> Path:
    """The directory with the wheels for the Python of a release of Debian."""
    # A kind for each, as the cache keeps two of a kind.
    room = ensure_suite(cache, f"wheelroom.{suite}", suite, PACKAGES)
    build = place / suite
    source = build / "dora-systemd"
    source.mkdir(parents=True)
    copy_files(CHECKOUT, source, list_checkout())
    settle(source, read_date(SOURCES[0]))
    command = ["pip", "wheel", "--no-deps", "--no-cache-dir", "--wheel-dir=wheels"]
    network = network_environment(build)
    with Stage(f"wheels for the Python of Debian {suite}"):
        words = [*command, "./dora-systemd", *COMPILED]
        run_in_room(room, build, words, network, has_network=True)
    return build / "wheels"


def deliver(wheels: Sequence[Path]) -> None:
    """Put them where docs/install.md has uv look for them, with a file of checksums."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    for wheel in wheels:
        shutil.copy(wheel, OUT)
    names = sorted(path.name for path in OUT.iterdir())
    sums = [f"{hashlib.sha256((OUT / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (OUT / "SHA256SUMS").write_text("".join(sums), encoding="ascii")
    say(f"{len(names)} wheels, see {OUT}: {' '.join(names)}")
