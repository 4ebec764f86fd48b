"""Who used the CPUs that a node waited for: processes, and the interrupts of devices. Pure.

See /proc/interrupts in proc(5), and "SMP IRQ affinity" in the kernel's documentation.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import INFINITY, cpu_bits, cpu_numbers, format_cpus, parse_cpus

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


_CPU = r"CPU(\d+)"
_LINE = r"\s*(\d{1,9}):((?:\s+\d+)+)\s*(.*)"
_NAMES = r"[,\s]+"
_MOST_NAMES = 3


class Interrupt(NamedTuple):
    """One line of /proc/interrupts, without those that CPUs send to each other."""

    number: int
    names: tuple[str, ...] = ()  # that the drivers have chosen
    total: int = 0  # since the boot


class Shared(NamedTuple):
    """Interrupts of a device that a node needs, on the CPUs of the node."""

    node: str
    needs: str  # the path or net:INTERFACE
    cpus: str  # those of the node
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    elsewhere: str = ""  # the other CPUs of the machine, "" for none

    def __str__(self) -> str:
        names = ", ".join(self.names[:_MOST_NAMES]) or "a driver"
        return f"the interrupts of {names} ({self.needs})"

    @property
    def remedy(self) -> str:
        """The command that moves them, which is the administrator's."""
        if not self.elsewhere:
            return "give the node other cpus: in its settings"
        paths = [f"/proc/irq/{number}/smp_affinity_list" for number in self.numbers]
        if len(paths) == 1:
            return f"as root: echo {self.elsewhere} > {paths[0]}"
        numbers = " ".join(map(str, self.numbers))
        path = "/proc/irq/$n/smp_affinity_list"
        return f"as root: for n in {numbers}; do echo {self.elsewhere} > {path}; done"

    def values(self) -> dict[str, Any]:
        return {
            "needs": self.needs,
            "names": list(self.names),
            "interrupts": list(self.numbers),
            "remedy": self.remedy,
        }


def parse_interrupts(text: str) -> dict[int, Interrupt]:
    """The interrupts of devices in /proc/interrupts, by number."""
    header, _, rest = text.partition("\n")
    cpus = len(re.findall(_CPU, header))
    found = (_parse_line(line, cpus) for line in rest.splitlines())
    return {one.number: one for one in found if one}


def _parse_line(line: str, cpus: int) -> Interrupt | None:
    match = re.fullmatch(_LINE, line)
    if match is None:
        return None
    # A number behind the counts belongs to the controller.
    counts = match[2].split()[:cpus]
    # The kernel writes two blanks before the names, and ", " between them.
    names = [one for one in re.split(_NAMES, match[3].rpartition("  ")[2]) if one]
    return Interrupt(int(match[1]), tuple(names), sum(map(int, counts)))


def interrupts_of_device(
    interrupts: Mapping[int, Interrupt], numbers: Collection[int], places: Collection[str]
) -> list[Interrupt]:
    """The interrupts of a device.

    numbers: those in the directory of its PCI device. places: names of the directories on the way
    to the device in /sys; without a PCI device, drivers use them as names of interrupts.
    """
    if numbers:
        return [interrupts[one] for one in sorted(numbers) if one in interrupts]
    return [one for one in interrupts.values() if _is_named(one, places)]


def _is_named(one: Interrupt, places: Collection[str]) -> bool:
    return any(name in places or name.rpartition(":")[2] in places for name in one.names)


def parse_cpu_list(text: str) -> int:
    """The CPUs of a file of the kernel as a number, 0 without any."""
    with suppress(DoraSystemdError):
        found = parse_cpus(text.strip())
        return 0 if found == INFINITY else found
    return 0


def share_interrupts(
    node: str, needs: str, cpus: int, online: int, found: Iterable[tuple[Interrupt, int]]
) -> Iterator[Shared]:
    """Yield what a node shares with a device that the node needs.

    cpus, online: those of the node and of the machine. found: the interrupts of the device, each
    with the CPUs that handle it.
    """
    hits = [one for one, own in found if one.total and own & cpus]
    if hits:
        names = tuple(dict.fromkeys(name for one in hits for name in one.names))
        numbers = tuple(one.number for one in hits)
        others = cpu_bits(set(cpu_numbers(online)) - set(cpu_numbers(cpus)))
        elsewhere = format_cpus(others) if others else ""
        yield Shared(node, needs, format_cpus(cpus), names, numbers, elsewhere)
