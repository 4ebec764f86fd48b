"""The processes of this machine and whose sockets are whose, from proc(5).

What belongs to other users is there for root alone; everything is gone the moment it was read.
"""

import contextlib
import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from dora_systemd.decisions.views.diagnosis import Process

PROC = Path("/proc")

_MOST_BYTES = 256 * 1024
_SOCKET = re.compile(r"socket:\[(\d+)\]")


def read_processes() -> list[Process]:
    """All processes that can be read, without kernel threads."""
    found = (_read_process(path) for path in PROC.glob("[0-9]*"))
    return sorted((one for one in found if one), key=lambda one: one.pid)


def socket_owners(inodes: Collection[int]) -> frozenset[int]:
    """The processes that hold one of these sockets."""
    paths = PROC.glob("[0-9]*/fd")
    return frozenset(int(path.parent.name) for path in paths if _holds(path, inodes))


def _read_process(path: Path) -> Process | None:
    try:
        command = _beginning(path / "cmdline").decode(errors="replace").split("\0")[:-1]
        # The name may hold blanks and parentheses; what follows it does not.
        parent = int((path / "stat").read_text(errors="replace").rpartition(")")[2].split()[1])
        group = (path / "cgroup").read_text().rpartition("0::")[2].strip()
    except (OSError, IndexError, ValueError):
        return None
    if not command:
        return None
    return Process(int(path.name), parent, tuple(command), group, _is_node(path))


def _is_node(path: Path) -> bool:
    try:
        return b"\0DORA_NODE_CONFIG=" in b"\0" + _beginning(path / "environ")
    except OSError:
        return False


def _beginning(path: Path) -> bytes:
    """As much as is needed: a process can have megabytes of arguments, and there are many."""
    with path.open("rb") as file:
        return file.read(_MOST_BYTES)


def _holds(directory: Path, inodes: Collection[int]) -> bool:
    return any(inode in inodes for inode in _sockets(directory))


def _sockets(directory: Path) -> Iterator[int]:
    with contextlib.suppress(OSError):
        for path in directory.iterdir():
            with contextlib.suppress(OSError):
                match = _SOCKET.fullmatch(os.readlink(path))  # noqa: PTH115
                if match:
                    yield int(match[1])
