"""Who uses the CPUs of this machine: processes, and the interrupts of devices, see proc(5)."""

import contextlib
import os
from collections.abc import Iterable, Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path

from dora_systemd.adapters.host.process_table import PROC, beginning
from dora_systemd.decisions.resources.rivals import (
    Interrupt,
    ProcessTime,
    interrupts_of_device,
    parse_cpu_list,
    parse_interrupts,
    parse_stat,
)

TICKS = os.sysconf("SC_CLK_TCK")
"""Per second."""
_MOST_BYTES = 4096
_MOST_THREADS = 256
_MOST_PROCESSES = 32_768


def read_times(proc: Path = PROC) -> dict[int, ProcessTime]:
    """The CPU time of each process."""
    found = {}
    for path in islice(proc.glob("[0-9]*"), _MOST_PROCESSES):
        if one := parse_stat(_text(path / "stat")):
            found[int(path.name)] = one
    return found


def read_thread_cpus(pid: int, proc: Path = PROC) -> frozenset[int]:
    """The CPUs on which the threads of a process ran last."""
    stats = (parse_stat(_text(path / "stat")) for path in _threads(pid, proc))
    return frozenset(one.cpu for one in stats if one)


def read_delay(pids: Iterable[int], proc: Path = PROC) -> int:
    """How long the threads of processes were ready to run and did not, in ns since their start.

    That is the second number in the file schedstat of each, without a CONFIG_SCHED_INFO 0.
    """
    threads = (path for pid in pids for path in _threads(pid, proc))
    return sum(_delay(path) for path in islice(threads, _MOST_THREADS))


def _delay(path: Path) -> int:
    numbers = _text(path / "schedstat").split()
    return int(numbers[1]) if len(numbers) > 1 else 0


def _threads(pid: int, proc: Path) -> Iterator[Path]:
    with contextlib.suppress(OSError):
        yield from islice((proc / str(pid) / "task").iterdir(), _MOST_THREADS)


def _text(path: Path, most: int = _MOST_BYTES) -> str:
    with contextlib.suppress(OSError):
        return beginning(path, most).decode(errors="replace").strip()
    return ""


_MOST_INTERRUPTS = 4 * 1024 * 1024
"""Bytes of /proc/interrupts, which has a column for each CPU."""
_DEVICES = "sys/devices"


class Interrupts:
    """The interrupts of this machine, read once. root: the directory with all its files."""

    def __init__(self, root: Path = Path("/")) -> None:
        self._root = root

    @cached_property
    def _known(self) -> dict[int, Interrupt]:
        return parse_interrupts(_text(self._root / "proc/interrupts", _MOST_INTERRUPTS))

    @cached_property
    def online(self) -> int:
        """The CPUs that are in use, as a number."""
        return parse_cpu_list(_text(self._root / "sys/devices/system/cpu/online"))

    def of_number(self, device: int, is_block: bool) -> list[tuple[Interrupt, int]]:
        """The interrupts of a device with this st_rdev, each with the CPUs that handle it."""
        kind = "block" if is_block else "char"
        return self._of(f"sys/dev/{kind}/{os.major(device)}:{os.minor(device)}")

    def of_interface(self, name: str) -> list[tuple[Interrupt, int]]:
        """The interrupts of a network interface, each with the CPUs that handle it."""
        return self._of(f"sys/class/net/{name}")

    def _of(self, link: str) -> list[tuple[Interrupt, int]]:
        directory = (self._root / link).resolve()
        top = (self._root / _DEVICES).resolve()
        if not directory.is_relative_to(top):
            return []
        ways = [one for one in (directory, *directory.parents) if top in one.parents]
        numbers = next(filter(None, map(_numbers, ways)), frozenset())
        found = interrupts_of_device(self._known, numbers, {one.name for one in ways})
        return [(one, self._cpus(one.number)) for one in found]

    def _cpus(self, number: int) -> int:
        """The CPUs that handle an interrupt; those that may, without an effective list."""
        directory = self._root / f"proc/irq/{number}"
        files = ("effective_affinity_list", "smp_affinity_list")
        return next(filter(None, (parse_cpu_list(_text(directory / one)) for one in files)), 0)


def _numbers(directory: Path) -> frozenset[int]:
    """The interrupts of a PCI device, none for another directory."""
    return frozenset(_listed(directory / "msi_irqs")) or _own(directory)


def _listed(directory: Path) -> Iterator[int]:
    with contextlib.suppress(OSError):
        yield from (int(one.name) for one in directory.iterdir() if one.name.isdecimal())


def _own(directory: Path) -> frozenset[int]:
    """The interrupt of a PCI device that shares a line; 0 is none."""
    text = _text(directory / "irq")
    return frozenset({int(text)} if text.isdecimal() and int(text) else ())
