"""A file of lines beside what it is about, which only the user who writes it can change.

What is appended is one write, so a power cut leaves at most one unfinished line; the next writer
removes it.
"""

import errno
import os
import stat
from pathlib import Path

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.files import read_file, unreadable
from dora_systemd.trust.paths import reached, refusal, sync_directory
from dora_systemd.values import shown

_FLAGS = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_MODE = 0o600


def read_lines(path: Path, most: int) -> bytes:
    """Read at most `most` bytes of the file at `path`; b"" if there is none.

    Raises DoraSystemdError as read_file() does.
    """
    try:
        with reached(path):
            pass
    except (FileNotFoundError, NotADirectoryError):
        return b""
    except OSError as error:
        raise unreadable(path, error) from error
    return read_file(path, most).data


def append_lines(path: Path, data: bytes) -> None:
    """Append whole lines to the file at `path`, and wait until they are on the disk.

    Raises DoraSystemdError (BAD_INPUT) for a file that another user can change, and if the disk
    does not take the lines.
    """
    try:
        with reached(path.parent) as (parent, _):
            fd = os.open(path.name, _FLAGS | os.O_CREAT, _MODE, dir_fd=parent)
        try:
            _check(path, os.fstat(fd))
            _drop_unfinished(fd)
            _write(fd, data)
            os.fsync(fd)
        finally:
            os.close(fd)
        sync_directory(path.parent)
    except OSError as error:
        message = f"cannot write to {shown(str(path))}: {error.strerror}"
        raise DoraSystemdError(message, "see df") from error


def _write(fd: int, data: bytes) -> None:
    """Write all of it, or leave nothing of it."""
    size = os.fstat(fd).st_size
    if os.write(fd, data) != len(data):
        os.ftruncate(fd, size)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _drop_unfinished(fd: int) -> None:
    """Remove the line that a power cut has left without its end."""
    size = os.fstat(fd).st_size
    if size and os.pread(fd, 1, size - 1) != b"\n":
        os.ftruncate(fd, os.pread(fd, size, 0).rfind(b"\n") + 1)


def _check(path: Path, status: os.stat_result) -> None:
    is_own = status.st_uid == os.geteuid() and status.st_nlink == 1
    if not stat.S_ISREG(status.st_mode) or not is_own or status.st_mode & 0o022:
        raise refusal(path, "another user can change it", "remove it")
