"""CPU time of processes, and how long they waited for a CPU, see proc(5)."""

import contextlib
import os
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

from dora_systemd.adapters.host.process_table import PROC, beginning
from dora_systemd.decisions.resources.rivals import ProcessTime, parse_stat

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


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return beginning(path, _MOST_BYTES).decode(errors="replace")
    return ""
