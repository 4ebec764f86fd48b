"""Processes of nodes that have started containers, and the processes in these, from proc(5)."""

import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

from dora_systemd.adapters.host.process_table import PROC, beginning, read_lock_process
from dora_systemd.decisions.resources.containers import CLIENTS, MONITOR, Client, client_of

_PROGRAMS = {MONITOR.encode(), *(one.encode() for one in CLIENTS)}
_MOST_BYTES = 64 * 1024
_MOST_PROCESSES = 32_768
_PARENT, _STARTED = 1, 19
"""Fields of /proc/PID/stat behind the name, from 0, see proc_pid_stat(5)."""
_TICKS = os.sysconf("SC_CLK_TCK")


def read_clients(pids: Iterable[int], proc: Path = PROC) -> list[Client]:
    """The clients among these processes."""
    found = (_client(pid, proc, _PROGRAMS) for pid in pids)
    return [one for one in found if one]


def read_monitors(proc: Path = PROC) -> list[Client]:
    """All monitors of containers on this machine."""
    pids = (int(path.name) for path in islice(proc.glob("[0-9]*"), _MOST_PROCESSES))
    found = (_client(pid, proc, {MONITOR.encode()}) for pid in pids)
    return [one for one in found if one]


def _client(pid: int, proc: Path, programs: Collection[bytes]) -> Client | None:
    # Most processes are none: their arguments need not be read.
    path = proc / str(pid)
    with suppress(OSError):
        if beginning(path / "comm").strip() in programs:
            data = beginning(path / "cmdline", _MOST_BYTES)
            words = data.decode(errors="replace").split("\0")[:-1]
            fields = _fields(path)
            if (found := client_of(pid, words)) and len(fields) > _STARTED:
                uid = read_lock_process(pid, proc).uid
                began = int(fields[_STARTED]) / _TICKS
                return found._replace(began=began, uid=uid, parent=int(fields[_PARENT]))
    return None


def process_start(pid: int, proc: Path = PROC) -> float:
    """When a process began, in seconds since the boot; 0 if it has ended."""
    fields = _fields(proc / str(pid))
    return int(fields[_STARTED]) / _TICKS if len(fields) > _STARTED else 0.0


def read_children(parents: Collection[int], proc: Path = PROC) -> Mapping[int, Sequence[int]]:
    """The children of some processes, by parent; all processes are read for it."""
    found: defaultdict[int, list[int]] = defaultdict(list)
    for path in islice(proc.glob("[0-9]*"), _MOST_PROCESSES):
        fields = _fields(path)
        if len(fields) > _PARENT and (parent := int(fields[_PARENT])) in parents:
            found[parent].append(int(path.name))
    return found


def _fields(path: Path) -> list[str]:
    """The fields of /proc/PID/stat after the name; [] if the process has ended."""
    with suppress(OSError):
        return beginning(path / "stat").decode(errors="replace").rpartition(")")[2].split()
    return []
