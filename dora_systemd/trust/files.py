"""Files that are read: never more than so many bytes, and of a regular file. Nothing hangs.

read_file() is for what others may own, see paths.py; read_own_file() for what the caller has named.
"""

import errno
import os
import stat
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.paths import Place, reached, refusal

MAX_BYTES = 1024 * 1024
"""Bytes of a file that we read: dora takes no descriptor above 1 MiB."""

# O_NONBLOCK: opening a FIFO would wait for a writer. O_NOCTTY: nor become our terminal.
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_NO_FILE = "there is no such file"
_REASONS = {
    errno.ENOENT: (_NO_FILE, "correct the path"),
    errno.ENOTDIR: (_NO_FILE, "correct the path"),
    errno.ELOOP: ("its symbolic links form a loop", "correct the path"),
    errno.ENAMETOOLONG: ("its name is too long", "correct the path"),
    errno.ENXIO: ("it is not a regular file", "give a file"),
    errno.EACCES: ("permission denied", "let the calling user read it"),
    errno.EPERM: ("permission denied", "let the calling user read it"),
}


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
            _check_regular(path, place.mode)
            # The same file again, now to be read: see proc_pid_fd(5).
            return Text(_read(f"/proc/self/fd/{found}", path, max_bytes), place)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def read_own_file(path: str | Path) -> bytes:
    """The same for a file that the caller has named: links are followed, whosever they are."""
    try:
        return _read(path, path, MAX_BYTES)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error


def unreadable(path: str | Path, error: OSError | ValueError) -> DoraSystemdError:
    """The error for a file that cannot be read."""
    known = _REASONS.get(getattr(error, "errno", 0) or 0)
    reason, hint = known or (str(getattr(error, "strerror", None) or error), "")
    return refusal(path, reason, hint)


def check_size(path: str | Path, data: bytes, most: int = MAX_BYTES) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if what was read from `path` is more than `most`."""
    if len(data) > most:
        raise refusal(path, f"it is larger than {most // 1024} KiB", "give a smaller file")


def _read(opened: str | Path, path: str | Path, most: int) -> bytes:
    fd = os.open(opened, _READ)
    try:
        _check_regular(path, os.fstat(fd).st_mode)
        with os.fdopen(fd, "rb", closefd=False) as file:
            data = file.read(most + 1)
    finally:
        os.close(fd)
    check_size(path, data, most)
    return data


def _check_regular(path: str | Path, mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise refusal(path, "it is a directory", "give the file in it")
    if not stat.S_ISREG(mode):
        raise refusal(path, "it is not a regular file", "give a file")
