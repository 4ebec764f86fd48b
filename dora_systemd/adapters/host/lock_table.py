"""Who holds a flock(2) on a file, from /proc/locks, see proc_locks(5), and what that process is.

Every entry may be out of date at once.
"""

import os
import re
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

from dora_systemd.adapters.host.process_table import PROC, beginning, group_in

_MOST_BYTES = 8 * 1024 * 1024
"""Of /proc/locks: 100,000 locks."""
_MOST_OF_PROCESS = 4096
_FLOCK = re.compile(rb"\d+: FLOCK +\S+ +(?:READ|WRITE) +(\d+) ([0-9a-f]+:[0-9a-f]+):(\d+) ")


class LockProcess(NamedTuple):
    """A process. uid: its effective user. inner_pid: in its own PID namespace. group: cgroup."""

    pid: int
    uid: int
    inner_pid: int
    command: str
    group: str


def read_flocks(device: int) -> Mapping[int, tuple[int, ...]]:
    """The processes that hold locks on files of a device (st_dev), by inode.

    A lock whose owner is in a PID namespace that the caller does not see is missing. Empty if the
    kernel does not tell.
    """
    wanted = b"%02x:%02x" % (os.major(device), os.minor(device))
    found: defaultdict[int, tuple[int, ...]] = defaultdict(tuple)
    with suppress(OSError), (PROC / "locks").open("rb") as file:
        for match in map(_FLOCK.match, file.read(_MOST_BYTES).split(b"\n")):
            if match and match[2] == wanted:
                found[int(match[3])] += (int(match[1]),)
    return found


def read_lock_process(pid: int) -> LockProcess:
    """What the kernel knows of a process; for one that has gone, its pid only. uid: -1 then."""
    path = PROC / str(pid)
    with suppress(OSError, ValueError, KeyError, IndexError):
        read = (beginning(path / one, _MOST_OF_PROCESS) for one in ("cmdline", "cgroup", "status"))
        arguments, groups, rest = read
        command = arguments.decode(errors="replace").replace("\0", " ").strip()
        lines = (line.partition(":") for line in rest.decode(errors="replace").split("\n"))
        status = {key: text.split() for key, _, text in lines}
        uid, inner = int(status["Uid"][1]), int(status["NSpid"][-1])
        return LockProcess(pid, uid, inner, command, group_in(groups))
    return LockProcess(pid, -1, pid, "", "")
