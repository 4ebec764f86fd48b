"""What the runner has taken out of a pipe and journald has not yet, in a file of the cell.

The file lies in memory, in the RuntimeDirectory, and outlives a runner that is killed: the process
of ExecStopPost= finds there what was on its way. The kernel moves the bytes from the pipe into the
file in one call, splice(2), so that they are always in one of the two. A kill between an entry and
the note of it gives that entry twice.
"""

import contextlib
import os
import struct
from pathlib import Path

SUFFIX = ".held"
# How many bytes are noted, and how many of the lines in them journald has.
_HEAD = struct.Struct("=QQ")
_TO_THE_END = (1 << 64) - 1
_MOST_DONE = 1 << 20
"""Bytes that journald has, before the file begins anew although a line has not ended."""


class HeldLines:
    """The bytes of one pipe that are on their way.

    It is a second line of defence: where its file cannot be written, nothing else fails.
    """

    def __init__(self, pipe: Path) -> None:
        self._path = held_path(pipe)
        self._size = 0
        self._lines = 0
        # Its file holds less than is on its way, so it holds nothing.
        self._is_broken = False
        self._fd = self._make(self._path, b"")

    def take(self, fd: int, size: int) -> bytes:
        """Read up to `size` bytes of the pipe `fd`, noted as on their way; b"" if it is empty.

        Raises BlockingIOError.
        """
        if not self._is_broken:
            try:
                return self._splice(fd, size)
            except BlockingIOError:
                raise
            except OSError:
                self._give_up()
        return os.read(fd, size)

    def _splice(self, fd: int, size: int) -> bytes:
        place = _HEAD.size + self._size
        count = os.splice(fd, self._fd, size, offset_dst=place)
        self._size += count
        return os.pread(self._fd, count, place)

    def add(self, data: bytes) -> None:
        """Note `data`, which was not in the pipe, as the next on its way."""
        if not self._is_broken:
            try:
                self._size += os.pwrite(self._fd, data, _HEAD.size + self._size)
            except OSError:
                self._give_up()

    def sent(self, lines: int) -> None:
        """Note that journald has the first `lines` lines."""
        if lines != self._lines and not self._is_broken:
            self._lines = lines
            with contextlib.suppress(OSError):
                os.pwrite(self._fd, _HEAD.pack(_TO_THE_END, lines), 0)

    def restart(self, rest: bytes) -> bool:
        """Journald has all but `rest`, a line that has not ended. Whether lines count anew."""
        if not rest:
            self._empty()
            return True
        if not self._is_broken and self._size - len(rest) < _MOST_DONE:
            return False
        try:
            self._replace(rest)
        except OSError:
            self._give_up()
        return True

    def close(self) -> None:
        """Close the file; what is in it stays."""
        os.close(self._fd)
        self._fd = -1  # what is noted from now on must not land in another file

    def _empty(self) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, _HEAD.size)
        self._size, self._is_broken = 0, False
        self.sent(0)

    def _replace(self, rest: bytes) -> None:
        """Another file in its place, at once: a kill finds the one or the other."""
        path = self._path.with_suffix(f"{SUFFIX}-new")
        fd = self._make(path, rest)
        path.replace(self._path)
        os.close(self._fd)
        self._fd = fd
        self._size, self._lines, self._is_broken = len(rest), 0, False

    def _make(self, path: Path, data: bytes) -> int:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(OSError):
            os.pwritev(fd, [_HEAD.pack(_TO_THE_END, 0), data], 0)
        return fd

    def _give_up(self) -> None:
        self._empty()
        self._is_broken = True


def held_path(pipe: Path) -> Path:
    """The file that belongs to a FIFO."""
    return pipe.with_name(pipe.name + SUFFIX)


def read_held(pipe: Path) -> tuple[bytes, int]:
    """What was on its way when the runner was killed, and how many lines of that journald has."""
    try:
        content = held_path(pipe).read_bytes()
        size, lines = _HEAD.unpack_from(content)
    except (OSError, struct.error):
        return b"", 0
    # The size is that of earlier versions, which may still run while they are replaced.
    return content[_HEAD.size : _HEAD.size + size], lines
