"""Which processes used the CPUs that a node waited for, between two samples. Pure."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

MOST_RIVALS = 3
WORTH_SHOWING = 5.0
"""Percent of a processor."""
_UTIME, _STIME, _PROCESSOR = 11, 12, 36
"""Fields of /proc/PID/stat behind the name, from 0, see proc_pid_stat(5)."""


class ProcessTime(NamedTuple):
    """The CPU time of a process or thread since its start."""

    command: str
    ticks: int
    cpu: int  # on which it ran last


class Rival(NamedTuple):
    """A process that used much CPU time."""

    pid: int
    command: str
    cpu_percent: float  # of one processor
    node: str = ""  # the node of a dataflow to which the process belongs, or ""

    def __str__(self) -> str:
        what = f"node {self.node}" if self.node else self.command
        return f"process {self.pid} ({what}, {self.cpu_percent:.0f}%)"

    def values(self) -> dict[str, Any]:
        """The process for JSON."""
        values = self._asdict()
        return {**values, "cpu_percent": round(self.cpu_percent, 1), "node": self.node or None}


def parse_stat(text: str) -> ProcessTime | None:
    """A line of /proc/PID/stat; the name in it may contain blanks and parentheses."""
    head, _, rest = text.rpartition(")")
    fields = rest.split()
    try:
        ticks = int(fields[_UTIME]) + int(fields[_STIME])
        return ProcessTime(head.partition("(")[2], ticks, int(fields[_PROCESSOR]))
    except (IndexError, ValueError):
        return None


def busiest(
    before: Mapping[int, ProcessTime],
    now: Mapping[int, ProcessTime],
    ticks: float,
    besides: Collection[int],
) -> list[Rival]:
    """The processes that used the most CPU time, most first.

    ticks: the length of the time between the samples. besides: processes that do not count.
    """
    found = [
        Rival(pid, one.command, 100.0 * (one.ticks - before[pid].ticks) / ticks)
        for pid, one in now.items()
        if pid in before and pid not in besides
    ]
    found = [one for one in found if one.cpu_percent >= WORTH_SHOWING]
    return sorted(found, key=lambda one: -one.cpu_percent)


def on_cpus(
    rivals: Sequence[Rival], threads: Mapping[int, Collection[int]], cpus: Collection[int]
) -> list[Rival]:
    """The rivals that ran on one of `cpus`, which are all if there are none.

    threads: by pid, the CPUs on which its threads ran last.
    """
    found = [one for one in rivals if not cpus or {*threads.get(one.pid, ())} & {*cpus}]
    return found[:MOST_RIVALS]
