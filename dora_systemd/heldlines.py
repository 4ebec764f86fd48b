"""What the runner has taken out of a pipe and journald has not yet, in a file of the cell.

The file lies in memory, in the RuntimeDirectory, and outlives a runner that is killed: the process
of ExecStopPost= finds there what was on its way. A kill between an entry and the note of it gives
that entry twice.
"""

import contextlib
import os
import struct
from pathlib import Path

SUFFIX = ".held"
# Bytes, and how many of the lines in them journald has.
_HEAD = struct.Struct("=QQ")


class HeldLines:
    """The bytes of one pipe that are on their way.

    It is a second line of defence: where its file cannot be written, nothing else fails.
    """

    def __init__(self, pipe: Path) -> None:
        self._size = 0
        self._lines = 0
        path = held_path(pipe)
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._fd = os.open(path, flags, 0o600)

    def add(self, data: bytes) -> None:
        """Note `data`, which has just been read."""
        size = self._size + len(data)
        with contextlib.suppress(OSError):
            # One call where it can be: a kill falls before or after it.
            if not self._size:
                os.pwritev(self._fd, [_HEAD.pack(size, self._lines), data], 0)
            else:
                os.pwrite(self._fd, data, _HEAD.size + self._size)
                os.pwrite(self._fd, _HEAD.pack(size, self._lines), 0)
        self._size = size

    def sent(self, lines: int) -> None:
        """Note that journald has the first `lines` lines."""
        self._lines = lines
        with contextlib.suppress(OSError):
            os.pwrite(self._fd, _HEAD.pack(self._size, lines), 0)

    def restart(self, rest: bytes) -> None:
        """Note that journald has all but `rest`, a line that has not ended."""
        self._size = self._lines = 0
        if rest:
            self.add(rest)
        else:
            self.sent(0)

    def close(self) -> None:
        """Close the file; what is in it stays."""
        os.close(self._fd)
        self._fd = -1  # what is noted from now on must not land in another file


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
    return content[_HEAD.size : _HEAD.size + size], lines
