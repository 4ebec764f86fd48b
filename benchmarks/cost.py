"""Private memory and idle CPU of supervision.  `python -m benchmarks.cost [N]`"""

import sys
import time
from pathlib import Path

from benchmarks.contestants import ALL, Contestant, prepared
from benchmarks.crowd import light_flow
from benchmarks.flows import clear_stamps, make_home, wait_stamps
from benchmarks.rounds import OURS, Figure, keep, shown

SETTLE_SECONDS = 10.0
WINDOW_SECONDS = 30.0
OF_DAEMONS = "beside dora"
OF_ALL = "with dora's own processes"


def private_mb(pid: int) -> float:
    """Memory that would be free without the process, in MB: proc_pid_smaps_rollup(5)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) * 1024 / 1e6


def cpu_seconds(pid: int) -> float:
    """What all threads have used: the first number of schedstat is in ns."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks) / 1e9


Pids = dict[str, list[int]]


def memory_figure(what: str, pids: Pids, goal: str) -> Figure:
    """Of each contestant's processes."""
    values = {name: [sum(map(private_mb, found))] for name, found in pids.items()}
    return shown(Figure(what, "MB", values, goal))


def cpu_figures(kinds: dict[str, Pids], rounds: int) -> list[Figure]:
    """Percent of a processor, of all contestants in the same windows."""
    values: dict[str, dict[str, list[float]]] = {
        what: {name: [] for name in pids} for what, pids in kinds.items()
    }
    every = {pid for pids in kinds.values() for found in pids.values() for pid in found}
    for _ in range(rounds):
        before = {pid: cpu_seconds(pid) for pid in every}
        time.sleep(WINDOW_SECONDS)
        used = {pid: cpu_seconds(pid) - before[pid] for pid in every}
        for what, pids in kinds.items():
            for name, found in pids.items():
                percent = 100 * sum(used[pid] for pid in found) / WINDOW_SECONDS
                values[what][name].append(percent)
    return [
        shown(Figure(f"CPU when idle, {what}", "%", found, goal))
        for (what, found), goal in zip(values.items(), ("≤ 0.1 %", ""), strict=True)
    ]


def begin(contestant: Contestant) -> None:
    """Have it run the dataflow."""
    clear_stamps()
    contestant.start()
    wait_stamps("ready", 1)


def measure(rounds: int) -> list[Figure]:
    """All at the same time, each with one node that does nothing."""
    flow = light_flow(make_home())
    with prepared(ALL, flow) as contestants:
        for one in contestants:
            begin(one)
        time.sleep(SETTLE_SECONDS)
        daemons = {one.name: found for one in contestants if (found := one.daemon_pids())}
        whole = {one.name: one.daemon_pids() + one.dora_pids() for one in contestants}
        assert OURS in daemons
        figures = [
            memory_figure(f"private memory, {OF_DAEMONS}", daemons, "≤ 13 MB"),
            memory_figure(f"private memory, {OF_ALL}", whole, ""),
            *cpu_figures({OF_DAEMONS: daemons, OF_ALL: whole}, rounds),
        ]
        for one in contestants:
            one.stop()
        return figures


if __name__ == "__main__":
    keep("cost", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 5)
