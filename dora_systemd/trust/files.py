"""Files that are read: never more than so many bytes, and of a regular file. Nothing hangs.

read_file() is for what others may own, see paths.py; read_own_file() for what the caller has named.
"""

import errno
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.eyes import check_regular, read_regular
from dora_systemd.trust.paths import Place, reached, refusal

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
            # The same file again, now to be read: see proc_pid_fd(5).
            data = read_regular(f"/proc/self/fd/{found}", max_bytes + 1)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from error
    check_size(path, data, max_bytes)
    return Text(data, place)


def read_own_file(path: str | Path) -> bytes:
    """The same for a file that the caller has named: links are followed, whosever they are."""
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
