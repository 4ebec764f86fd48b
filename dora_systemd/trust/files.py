"""Files that are read: never more than so many bytes, and of a regular file. Nothing hangs.

read_file() is for what others may own, see paths.py; read_own_file() for what the caller has named.

read_table() and read_times() read what the nodes of a dataflow can write. The RuntimeDirectory of
its unit belongs to the nodes' user, so a node can replace any file that the runner wrote there.
`list` shows all dataflows together: a bad file of one must not hide the others.

append_lines() is one write, so a power cut leaves at most one unfinished line, which the next
writer removes.
"""

import errno
import os
import stat
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import TABLE, CellPaths
from dora_systemd.trust.eyes import check_regular, read_regular
from dora_systemd.trust.paths import Place, reached, refusal, sync_directory
from dora_systemd.values import shown

MAX_BYTES = 1024 * 1024
"""Bytes of a file that we read: dora takes no descriptor above 1 MiB."""

_NO_FILE = "there is no such file"
_REASONS = {
    errno.ENOENT: (_NO_FILE, "correct the path"),
    errno.ENOTDIR: (_NO_FILE, "correct the path"),
    errno.ELOOP: ("its symbolic links form a loop", "correct the path"),
    errno.ENAMETOOLONG: ("its name is too long", "correct the path"),
    errno.EISDIR: ("it is a directory", "give the file in it"),
    errno.ENXIO: ("it is not a regular file", "give a file"),
    errno.EACCES: ("permission denied", "let the calling user read it"),
    errno.EPERM: ("permission denied", "let the calling user read it"),
}
_FLAGS = os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_MODE = 0o600
MAX_TABLE = 2 * 1024 * 1024
"""Maximum bytes of a node table; one of 2000 nodes is smaller."""
_NOT_THERE = (FileNotFoundError, NotADirectoryError, PermissionError)


class Text(NamedTuple):
    """A file that was read, and the place of the descriptor that it was read from."""

    data: bytes
    place: Place


def read_file(path: str | Path, max_bytes: int = MAX_BYTES) -> Text:
    """The regular file at the absolute `path`, at most `max_bytes`.

    Raises DoraSystemdError (BAD_INPUT) when there is no such file, it is anything but a regular
    file, too large or unreadable, or behind a link that is not root's.
    """
    try:
        with reached(path) as (found, place):
            check_regular(place.mode)
            # Open the file again, for reading, by its descriptor: see proc_pid_fd(5).
            data = read_regular(f"/proc/self/fd/{found}", max_bytes + 1)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    check_size(path, data, max_bytes)
    return Text(data, place)


def read_own_file(path: str | Path) -> bytes:
    """Like read_file(), for a path given by the caller: follows symbolic links of any owner."""
    try:
        data = read_regular(path, MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    check_size(path, data)
    return data


def unreadable(path: str | Path, error: OSError | ValueError) -> DoraSystemdError:
    """The error for a file that cannot be read."""
    known = _REASONS.get(getattr(error, "errno", 0) or 0)
    reason, hint = known or (str(getattr(error, "strerror", None) or error), "")
    return refusal(path, reason, hint)


def check_size(path: str | Path, data: bytes, most: int = MAX_BYTES) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if what was read from `path` is more than `most`."""
    if len(data) > most:
        raise refusal(path, f"it is larger than {most // 1024} KiB", "give a smaller file")


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


def read_table(directory: Path) -> CellStatus | None:
    """The node table in a RuntimeDirectory; None if it is missing or the caller may not read it.

    Raises DoraSystemdError (BAD_INPUT) if the owner of the table does not own the directory, and
    DoraSystemdError for content that no runner writes.
    """
    data = _read(f"{directory}/{TABLE}", MAX_TABLE)
    return None if data is None else CellStatus.from_json(data)


def read_times(directory: Path, size: int) -> bytes:
    """The file of times in a RuntimeDirectory; b"" if it is not usable, or has more than `size`.

    decisions/owes/probe.py documents the content.
    """
    try:
        return _read(CellPaths(directory).times, size) or b""
    except DoraSystemdError:
        return b""


def _read(path: str | Path, most: int) -> bytes | None:
    """A file that the owner of its directory owns, or None. Raises DoraSystemdError."""
    try:
        text = read_file(path, most)
    except DoraSystemdError as error:
        if isinstance(error.__cause__, _NOT_THERE):
            return None
        raise
    if text.place.borrowed:
        reason = f"it is not of the user whose dataflow it is: {text.place.borrowed}"
        raise refusal(path, reason, "another user put it there")
    return text.data
