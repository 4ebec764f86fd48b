"""Notices when the entries of directories change, or also files in them, by inotify(7).

Not by watchfiles, which also receives an event for every open and write: in /dev for each use of
/dev/null by any process of the machine.
"""

import contextlib
import ctypes
import os
from collections.abc import Iterable

_CREATE, _DELETE, _DELETE_SELF, _MOVE_SELF = 0x100, 0x200, 0x400, 0x800
_MOVED_FROM, _MOVED_TO, _ATTRIB, _ONLYDIR = 0x40, 0x80, 0x4, 0x01000000
_MASK = _CREATE | _DELETE | _DELETE_SELF | _MOVE_SELF | _MOVED_FROM | _MOVED_TO | _ATTRIB | _ONLYDIR
MODIFY = 0x2
"""For changes of the files in a directory, too."""
_BUFFER = 64 * 1024


class Inotify:
    """An inotify instance. Raises OSError if the kernel gives none. Close it.

    more: other events than those of entries, such as MODIFY.
    """

    def __init__(self, more: int = 0) -> None:
        self._mask = _MASK | more
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.fd = self._checked(self._libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
        self._watches: dict[str, int] = {}

    def _checked(self, result: int) -> int:
        if result < 0:
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error))
        return result

    def watch(self, directories: Iterable[str]) -> set[str]:
        """Watch these directories and no others; return those that exist."""
        wanted, found = set(directories), set()
        for path in self._watches.keys() - wanted:
            self._libc.inotify_rm_watch(self.fd, self._watches.pop(path))
        for path in wanted:
            # Also those that are watched already: another directory may have this name now.
            with contextlib.suppress(OSError):
                number = self._libc.inotify_add_watch(self.fd, os.fsencode(path), self._mask)
                self._watches[path] = self._checked(number)
                found.add(path)
        return found

    def drain(self) -> None:
        """Read and discard all events, because any event means only that something has changed."""
        with contextlib.suppress(BlockingIOError):
            while os.read(self.fd, _BUFFER):
                pass

    def close(self) -> None:
        os.close(self.fd)
