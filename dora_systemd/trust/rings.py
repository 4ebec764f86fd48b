"""Finds the memory of a recorder in the process that keeps it: systemd's manager.

Every user's unit can have systemd keep a file of any name. So a ring counts only if it is a regular
file that belongs to the user of the dataflow, and its header has the UUID of that. What it contains
is hostile: see dora_systemd.decisions.recorder.reading.
"""

import os
import stat
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

from dora_systemd.decisions.recorder.ring import ALIGN, Header, parse_header

_LINK = "/memfd:dora-ring"
"""How /proc/PID/fd names the file, see fd_store.py; " (deleted)" follows."""
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NOCTTY | os.O_NONBLOCK
_PROC = Path("/proc")


class RingFile:
    """The file of a ring, for decisions/recorder/reading.py."""

    def __init__(self, fd: int, header: Header) -> None:
        self._fd = fd
        self._is_open = True
        self.header = header
        self.size = os.fstat(fd).st_size

    def read(self, at: int, size: int) -> bytes:
        """Read; what is a hole is 0."""
        return os.pread(self._fd, size, at)

    @property
    def used(self) -> int:
        """Bytes of memory that the ring takes."""
        return os.fstat(self._fd).st_blocks * 512

    def again(self) -> "RingFile":
        """Open the same file once more; each of the two is closed by itself."""
        return RingFile(os.dup(self._fd), self.header)

    def close(self) -> None:
        """Close the file, once."""
        if self._is_open:
            self._is_open = False
            os.close(self._fd)


def find_ring(pids: Iterable[int], uuid: str, uid: int, proc: Path = _PROC) -> RingFile | None:
    """The ring of the dataflow `uuid` of the user `uid` that one of the processes keeps, or None.

    Processes of which this one may not see the files have none.
    """
    for pid in pids:
        for path in _rings(proc / str(pid) / "fd"):
            if found := _open(path, uuid, uid):
                return found
    return None


def _rings(directory: Path) -> list[Path]:
    with suppress(OSError):
        return [one for one in directory.iterdir() if _target(one).startswith(_LINK)]
    return []


def _target(path: Path) -> str:
    with suppress(OSError):  # the process closes files at any moment
        return str(path.readlink())
    return ""


def _open(path: Path, uuid: str, uid: int) -> RingFile | None:
    fd = _open_own(path, uid)
    if fd is None:
        return None
    with suppress(OSError, ValueError):
        header = parse_header(os.pread(fd, ALIGN, 0))
        if header.facts.get("uuid") == uuid:
            return RingFile(fd, header)
    os.close(fd)
    return None


def _open_own(path: Path, uid: int) -> int | None:
    """Open a regular file of the user, and nothing else: opening a device can do something.

    In a mount namespace of an own, any user can give any file the name of a ring.
    """
    with suppress(OSError), ExitStack() as held:
        found = os.open(path, os.O_PATH | os.O_CLOEXEC)
        held.callback(os.close, found)
        status = os.fstat(found)
        if stat.S_ISREG(status.st_mode) and status.st_uid == uid:
            return os.open(f"/proc/self/fd/{found}", _FLAGS)  # see proc_pid_fd(5)
    return None
