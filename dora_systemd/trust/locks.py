"""The lock file in the RuntimeDirectory of a dataflow, which root's doractl must not trust.

The directory belongs to the nodes' user, who can put anything there. The file is opened by
descriptor and must be a regular file of that user. No function of this module waits.
"""

import contextlib
import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.trust.eyes import check_regular
from dora_systemd.trust.files import unreadable
from dora_systemd.trust.paths import STEP, Place, reached, refusal

T = TypeVar("T")

_MOST_BYTES = 64 * 1024
"""Bytes of reasons that are read from the end of the file."""


class LockPlace(NamedTuple):
    """The identity of a lock file: st_dev and st_ino."""

    device: int
    inode: int


def find_lock(directory: Path) -> LockPlace | None:
    """The lock file in a RuntimeDirectory; None if there is none.

    Raises DoraSystemdError: BAD_INPUT for anything but a regular file of the directory's owner,
    NO_PERMISSION if the caller may not look.
    """
    return _at_lock(directory, place_of)


def open_lock(directory: Path) -> int | None:
    """A new descriptor of the lock file; None if there is none. Raises as find_lock()."""
    return _at_lock(directory, _open_again)


def place_of(lock: int) -> LockPlace:
    """The identity of an open lock file."""
    status = os.fstat(lock)
    return LockPlace(status.st_dev, status.st_ino)


def take_lock(directory: Path, lock: int, is_shared: bool) -> bool:
    """Lock the open lock file of a RuntimeDirectory, see flock(2); False if others hold a lock.

    Raises DoraSystemdError if the kernel cannot lock at all, such as without memory (ENOLCK).
    """
    operation = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    try:
        fcntl.flock(lock, operation | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        message = f"cannot lock {CellPaths(directory).lock}: {error.strerror}"
        raise DoraSystemdError(message, "see flock(2) for what this means") from error
    return True


def write_reason(lock: int, line: bytes) -> None:
    """Append a line to an open lock file; a full file system loses the reason, not the lock."""
    with contextlib.suppress(OSError):
        os.write(lock, line)


def read_reasons(lock: int) -> bytes:
    """The end of an open lock file."""
    begin = max(os.fstat(lock).st_size - _MOST_BYTES, 0)
    return os.pread(lock, _MOST_BYTES, begin)


def _open_again(found: int) -> int:
    """Open the file of a descriptor (O_PATH), see proc_pid_fd(5)."""
    # O_NONBLOCK: its owner may have a lease on it, see fcntl(2).
    flags = os.O_RDWR | os.O_APPEND | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    return os.open(f"/proc/self/fd/{found}", flags)


def _at_lock(directory: Path, use: Callable[[int], T]) -> T | None:
    """Call `use` with a descriptor (O_PATH) of the lock file. Raises as find_lock()."""
    path = CellPaths(directory).lock
    try:
        with reached(directory) as (parent, place):
            # Never a link, not even one of root's: we write to the file.
            found = os.open(path.name, STEP, dir_fd=parent)
            try:
                _check(path, os.fstat(found), place)
                return use(found)
            finally:
                os.close(found)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except PermissionError as error:
        message = f"cannot use {path}: permission denied"
        hint = "use sudo: only root and the user it runs as may"
        raise DoraSystemdError(message, hint, ExitCode.NO_PERMISSION) from error
    except OSError as error:
        raise unreadable(path, error) from error


def _check(path: Path, status: os.stat_result, parent: Place) -> None:
    """Raise OSError or DoraSystemdError unless it is a plain file of the directory's owner."""
    check_regular(status.st_mode)
    if status.st_uid != parent.uid or parent.borrowed or status.st_nlink > 1:
        reason = "it is not, or not only, the lock file of the dataflow"
        raise refusal(path, reason, "restart the dataflow: it makes a new one")
