"""`list` and `start` of the package on a release of Debian, beside `dora --version` there.

    make bench-platforms

A ratio to a program of the same machine can be compared with that of another release.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from benchmarks.rounds import OURS, Figure, alternate, keep
from benchmarks.startup import timed
from tests.system.cells import Project, run

DORACTL = "/usr/bin/doractl"
"""The package's, not that of the checkout."""
RIVAL = "dora --version"
NAME = "robot"


@contextmanager
def project() -> Iterator[Path]:
    """A dataflow of three nodes."""
    place = Path(tempfile.mkdtemp(prefix="bench-", dir="/var/tmp"))
    place.chmod(0o755)
    yield Project(place / "project").three_nodes()
    shutil.rmtree(place)


def start(flow: Path) -> float:
    """ms until all of its nodes run; the stop is not counted."""
    words = ("--name", NAME, "--venv", "/opt/lab", "--network", "host")
    taken = timed(partial(run, DORACTL, "start", str(flow), *words))
    run(DORACTL, "stop", NAME)
    return taken


def measure(rounds: int) -> list[Figure]:
    """Each in turns with dora."""
    dora: Callable[[], float] = partial(timed, partial(run, "/usr/bin/dora", "--version"))
    listing: Callable[[], float] = partial(timed, partial(run, DORACTL, "list"))
    with project() as flow:
        starting: Callable[[], float] = partial(start, flow)
        for warm_up in (dora, listing, starting):
            warm_up()
        return [
            alternate("`list` with no dataflow", "ms", {OURS: listing, RIVAL: dora}, 3 * rounds),
            alternate("`start` of 3 nodes", "ms", {OURS: starting, RIVAL: dora}, rounds),
        ]


if __name__ == "__main__":
    keep(f"platform-{os.environ['LAB']}", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 10)
