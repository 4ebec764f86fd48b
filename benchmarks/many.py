"""`list`, one more start, memory, with up to 200.  `python -m benchmarks.many [N]`"""

import sys
from functools import partial

from benchmarks.contestants import Contestant, Doractl, DoraRun, SystemdRun, prepared
from benchmarks.cost import private_mb
from benchmarks.crowd import COUNTS, Crowd, crowd
from benchmarks.flows import make_home
from benchmarks.rounds import EMPTY, OURS, Figure, alternate, keep, shown
from benchmarks.start import start_ms
from benchmarks.startup import listings

LISTS = {50: f"≤ 4.5 {EMPTY}", 200: f"≤ 12 {EMPTY}"}
STARTS = {1: f"≤ 24 {EMPTY}"}
"""Goals of numbers of dataflows."""


def start_figure(contestants: list[Contestant], count: int, rounds: int) -> Figure:
    """One more, beside those that are there."""
    measures = {one.name: partial(start_ms, one, 1) for one in contestants}
    for warm_up in measures.values():
        warm_up()
    return alternate(
        f"start beside {count}", "ms", measures, rounds, goal=STARTS.get(count, "flat")
    )


def memory_figure(all_of_them: Crowd, count: int) -> Figure:
    """Runner, coordinator and daemon of each, on average."""
    pids = [pid for cell in all_of_them.cells for pid in cell.pids("supervisor")]
    values = {OURS: [sum(map(private_mb, pids)) / count]}
    return shown(Figure(f"private memory for each of {count}", "MB", values, "flat"))


def measure(rounds: int, counts: tuple[int, ...] = COUNTS) -> list[Figure]:
    """All of them at each number."""
    project = make_home()
    lists, starts, memory = [], [], []
    with crowd(project) as everyone:
        for count in counts:
            everyone.grow(count)
            commands = listings(everyone.rivals)
            for warm_up in commands.values():
                warm_up()
            about = {"goal": LISTS.get(count, ""), "at": count}
            lists.append(alternate(f"`list` of {count}", "ms", commands, rounds, **about))
            with prepared((Doractl, SystemdRun, DoraRun), everyone.flow) as contestants:
                starts.append(start_figure(contestants, count, max(rounds // 2, 1)))
            memory.append(memory_figure(everyone, count))
    return [*lists, *starts, *memory]


if __name__ == "__main__":
    keep("many", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 10)
