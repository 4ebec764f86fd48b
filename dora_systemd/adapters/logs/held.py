"""Keeps the bytes that the runner has read from a pipe and journald does not have, in a file.

The file is in the RuntimeDirectory, which is in memory, and outlives a runner that is killed: the
process of ExecStopPost= sends its content to journald. splice(2) moves the bytes from the pipe to
the file in one system call, so they are always in one of the two. A kill after an entry was sent,
and before that was noted, sends the entry twice.
"""

import contextlib
import os
import struct
from pathlib import Path

SUFFIX = ".held"
# The header: number of bytes, and number of the lines among them that journald has.
_HEAD = struct.Struct("=QQ")
_TO_THE_END = (1 << 64) - 1
_MOST_DONE = 1 << 20
"""Bytes that journald has taken, after which a new file begins even in the middle of a line."""


class HeldLines:
    """The bytes of one pipe that journald does not have yet.

    Only a kill of the runner needs the file, so a failure to write it affects nothing else.
    """

    def __init__(self, pipe: Path) -> None:
        self._path = held_path(pipe)
        self._size = 0
        self._lines = 0
        # The file would lack some of these bytes, so it stays empty.
        self._is_broken = False
        self._fd = self._make(self._path, b"")

    def take(self, fd: int, size: int) -> bytes:
        """Read up to `size` bytes from the pipe `fd` and keep them; b"" at the end of the file.

        Raises BlockingIOError if the pipe is empty.
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
        """Keep `data`, which did not come from the pipe, after the other bytes."""
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
        """journald has all but the unterminated line `rest`; whether lines count from 0 again."""
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
        """Close the file, and leave it in place."""
        os.close(self._fd)
        self._fd = -1  # later calls must not write to another file with this number

    def _empty(self) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, _HEAD.size)
        self._size, self._is_broken = 0, False
        self.sent(0)

    def _replace(self, rest: bytes) -> None:
        """Replace the file atomically: after a kill there is the old or the new one."""
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
    """The bytes kept when the runner was killed, and how many of their lines journald has."""
    try:
        content = held_path(pipe).read_bytes()
        size, lines = _HEAD.unpack_from(content)
    except (OSError, struct.error):
        return b"", 0
    # Older versions write a real size, and may still be running after an upgrade.
    return content[_HEAD.size : _HEAD.size + size], lines
