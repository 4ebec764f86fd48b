"""From the command to 2, 5 and 20 Python nodes that are ready.  `python -m benchmarks.start [N]`"""

import sys
import time
from functools import partial

from benchmarks.contestants import ALL, BARE, Contestant, prepared
from benchmarks.flows import clear_stamps, make_home, wait_gone, wait_stamps, write_flow
from benchmarks.rounds import EMPTY, Figure, alternate, keep
from tests.system.cells import Project

SIZES = (2, 5, 20)


def start_ms(contestant: Contestant, count: int) -> float:
    """One start, and a stop behind the clock."""
    clear_stamps()
    begun = time.monotonic()
    contestant.start()
    ready = wait_stamps("ready", count)
    contestant.stop()
    wait_gone([stamp.pid for stamp in ready])
    return (max(stamp.at for stamp in ready) - begun) * 1000


def start_figure(project: Project, count: int, rounds: int) -> Figure:
    """All supervisors where a dataflow is small, dora and systemd where it is larger."""
    kinds = ALL if count == SIZES[0] else BARE
    with prepared(kinds, write_flow(project, count)) as contestants:
        measures = {one.name: partial(start_ms, one, count) for one in contestants}
        for warm_up in measures.values():
            warm_up()
        what = f"start to all of {count} nodes ready"
        goal = f"≤ 30 {EMPTY}" if count == SIZES[0] else "≤ 1.15 × dora"
        return alternate(what, "ms", measures, rounds, goal=goal, at=count)


def measure(rounds: int, sizes: tuple[int, ...] = SIZES) -> list[Figure]:
    """All sizes."""
    project = make_home()
    return [start_figure(project, count, rounds) for count in sizes]


if __name__ == "__main__":
    keep("start", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)
