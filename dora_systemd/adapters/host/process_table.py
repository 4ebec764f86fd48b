"""The processes of this machine, and who holds which sockets and locks, from proc(5).

Only root sees all details of other users' processes. Every entry may be out of date at once.
"""

import contextlib
import os
import re
from collections import defaultdict
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from dora_systemd.decisions.views.diagnosis import Process

PROC = Path("/proc")

_MOST_BYTES = 256 * 1024
_SOCKET = r"socket:\[(\d+)\]"
_MOST_OF_LOCKS = 8 * 1024 * 1024
"""Bytes read of /proc/locks: 100,000 locks."""
_MOST_OF_PROCESS = 4096
_FLOCK = rb"\d+: FLOCK +\S+ +(?:READ|WRITE) +(\d+) ([0-9a-f]+:[0-9a-f]+):(\d+) "


def read_processes(proc: Path = PROC) -> "list[Process]":
    """Read all readable processes, without kernel threads."""
    found = (_read_process(path) for path in proc.glob("[0-9]*"))
    return sorted((one for one in found if one), key=lambda one: one.pid)


def session_members(session: int, proc: Path = PROC) -> list[int]:
    """The processes of a session, see setsid(2)."""
    return [int(path.name) for path in proc.glob("[0-9]*") if _session(path) == session]


def _session(path: Path) -> int | None:
    try:
        return int(status_fields(path)[3])
    except (OSError, IndexError, ValueError):
        return None


def status_fields(path: Path) -> list[str]:
    """The fields of /proc/PID/stat after the name, which may contain blanks and parentheses."""
    return (path / "stat").read_text(errors="replace").rpartition(")")[2].split()


def socket_owners(inodes: Collection[int], proc: Path = PROC) -> frozenset[int]:
    """The processes that hold one of these sockets."""
    paths = proc.glob("[0-9]*/fd")
    return frozenset(int(path.parent.name) for path in paths if _holds(path, inodes))


def _read_process(path: Path) -> "Process | None":
    from dora_systemd.decisions.views.diagnosis import Process

    try:
        command = beginning(path / "cmdline").decode(errors="replace").split("\0")[:-1]
        parent = int(status_fields(path)[1])
        group = group_in(beginning(path / "cgroup"))
    except (OSError, IndexError, ValueError):
        return None
    if not command:
        return None
    return Process(int(path.name), parent, tuple(command), group, _is_node(path))


def group_in(data: bytes) -> str:
    """The cgroup in the content of /proc/PID/cgroup, see cgroups(7); "" if there is none.

    Any user can have groups whose names are any bytes but a newline.
    """
    lines = data.decode(errors="replace").split("\n")
    return next((line[3:] for line in lines if line.startswith("0::")), "")


def process_group(pid: int, proc: Path = PROC) -> str:
    """The cgroup of a process, "" if it has ended."""
    with suppress(OSError):
        return group_in(beginning(proc / str(pid) / "cgroup"))
    return ""


def _is_node(path: Path) -> bool:
    try:
        return b"\0DORA_NODE_CONFIG=" in b"\0" + beginning(path / "environ")
    except OSError:
        return False


def beginning(path: Path, size: int = _MOST_BYTES) -> bytes:
    """Read at most `size` bytes of a file: arguments can have megabytes, and processes are many.

    Raises OSError.
    """
    with path.open("rb") as file:
        return file.read(size)


def _holds(directory: Path, inodes: Collection[int]) -> bool:
    with contextlib.suppress(OSError):
        for path in directory.iterdir():
            with contextlib.suppress(OSError):
                match = re.fullmatch(_SOCKET, os.readlink(path))  # noqa: PTH115
                if match and int(match[1]) in inodes:
                    return True
    return False


class LockProcess(NamedTuple):
    """A process."""

    pid: int
    uid: int  # its effective user
    inner_pid: int  # in its own PID namespace
    command: str
    group: str  # cgroup


def read_flocks(device: int) -> Mapping[int, tuple[int, ...]]:
    """The processes with a flock(2) on files of a device (st_dev), by inode, see proc_locks(5).

    A lock whose owner is in a PID namespace that the caller does not see is missing. Empty if
    /proc/locks cannot be read.
    """
    wanted = b"%02x:%02x" % (os.major(device), os.minor(device))
    found: defaultdict[int, tuple[int, ...]] = defaultdict(tuple)
    with suppress(OSError), (PROC / "locks").open("rb") as file:
        for line in file.read(_MOST_OF_LOCKS).split(b"\n"):
            match = re.match(_FLOCK, line)
            if match and match[2] == wanted:
                found[int(match[3])] += (int(match[1]),)
    return found


def read_lock_process(pid: int, proc: Path = PROC) -> LockProcess:
    """Read the facts of a process; of an ended process only the pid, with uid -1."""
    path = proc / str(pid)
    with suppress(OSError, ValueError, KeyError, IndexError):
        read = (beginning(path / one, _MOST_OF_PROCESS) for one in ("cmdline", "cgroup", "status"))
        arguments, groups, rest = read
        command = arguments.decode(errors="replace").replace("\0", " ").strip()
        lines = (line.partition(":") for line in rest.decode(errors="replace").split("\n"))
        status = {key: text.split() for key, _, text in lines}
        uid, inner = int(status["Uid"][1]), int(status["NSpid"][-1])
        return LockProcess(pid, uid, inner, command, group_in(groups))
    return LockProcess(pid, -1, pid, "", "")
