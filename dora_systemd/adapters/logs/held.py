"""Keeps the bytes that the runner has read from a pipe and journald does not have, in a file.

systemd's file descriptor store keeps what is still in the pipe, and that is not enough: a flood, a
prompt without a newline and a line longer than the pipe all lost lines when the runner was killed.
Copying with tee(2), and reading once journald has the line, would save only the flood: a prompt
keeps the pipe readable, so the runner would spin, and a line longer than the pipe would never be
complete.

The file is in the RuntimeDirectory, which is in memory, and outlives a runner that is killed: the
process of ExecStopPost= sends its content to journald. splice(2) moves the bytes from the pipe to
the file in one system call, so they are always in one of the two. A kill between sending an entry
and recording that sends the entry twice.
"""

import contextlib
import errno
import os
import struct
from pathlib import Path

SUFFIX = ".held"
# The header: number of the lines that journald has.
_HEAD = struct.Struct("=Q")
_MOST_DONE = 1 << 20
"""Bytes that journald has taken, after which a new file begins even in the middle of a line."""


class HeldLines:
    """The bytes of one pipe that journald does not have yet.

    Only a kill of the runner needs the file, so a failure to write it affects nothing else.
    """

    def __init__(self, pipe: Path) -> None:
        self._path = held_path(pipe)
        self._fd = -1
        self._size = self._done = self._noted = 0
        # The file would lack some bytes, so it stays empty until nothing waits.
        self._is_broken = self._is_closed = False
        try:
            self._begin(b"")
        except OSError:
            self._give_up()

    def take(self, fd: int, size: int) -> bytes:
        """Read up to `size` bytes from the pipe `fd` and keep them; b"" at the end of the file.

        Raises BlockingIOError if the pipe is empty.
        """
        if not self._is_broken:
            place = _HEAD.size + self._size
            try:
                count = os.splice(fd, self._fd, size, offset_dst=place)
                self._size += count
                return os.pread(self._fd, count, place)
            except BlockingIOError:
                raise
            except OSError:
                self._give_up()
        return os.read(fd, size)

    def add(self, data: bytes) -> None:
        """Keep `data`, which did not come from the pipe, after the other bytes."""
        if not self._is_broken:
            try:
                self._size += os.pwrite(self._fd, data, _HEAD.size + self._size)
            except OSError:
                self._give_up()

    def sent(self, lines: int) -> None:
        """Record that journald has the first `lines` lines of the oldest batch."""
        if self._done + lines != self._noted and not self._is_broken:
            self._noted = self._done + lines
            with contextlib.suppress(OSError):
                os.pwrite(self._fd, _HEAD.pack(self._noted), 0)

    def sent_all(self, lines: int, rest: bytes | None) -> None:
        """Record that journald has the oldest batch, which has `lines` lines.

        rest: the unterminated line at the end of this batch; None if other batches wait.
        """
        self._done += lines
        if rest is None or self._is_closed:
            self.sent(0)
        elif self._is_broken or (rest and self._size - len(rest) >= _MOST_DONE):
            try:
                self._begin(rest)
            except OSError:
                self._give_up()
        elif rest:
            self.sent(0)
        else:
            self._empty()

    def close(self) -> None:
        """Close the file, and leave it in place."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1  # later calls must not write to another file with this number
        self._is_closed = True

    def _empty(self) -> None:
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, _HEAD.size)
        self._size, self._done, self._is_broken = 0, 0, False
        self.sent(0)

    def _begin(self, rest: bytes) -> None:
        """Replace the file atomically: after a kill there is the old or the new one."""
        path = self._path.with_suffix(f"{SUFFIX}-new")
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            # Less is written where the disk is almost full.
            if os.pwritev(fd, [_HEAD.pack(0), rest], 0) < _HEAD.size + len(rest):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            path.replace(self._path)
        except OSError:
            os.close(fd)
            raise
        if self._fd >= 0:
            os.close(self._fd)
        self._fd, self._size, self._is_broken = fd, len(rest), False
        self._done = self._noted = 0

    def _give_up(self) -> None:
        self._empty()
        self._is_broken = True


def held_path(pipe: Path) -> Path:
    """Return the path of the file with the held bytes of a FIFO."""
    return pipe.with_name(pipe.name + SUFFIX)


def read_held(pipe: Path) -> tuple[bytes, int]:
    """The bytes kept when the runner was killed, and how many of their lines journald has."""
    try:
        content = held_path(pipe).read_bytes()
        (lines,) = _HEAD.unpack_from(content)
    except (OSError, struct.error):
        return b"", 0
    return content[_HEAD.size :], lines
