"""dora's own log file of a node, followed: for nodes whose output dora's daemon must read itself.

The daemon appends to log_<node>.jsonl, over restarts too, and may rotate it: then it is renamed
to log_<node>.1.jsonl, that one to .2, and so on. Rotations are found by inode, so nothing is
read twice or passed over as long as dora keeps one file more than was written between two looks.
"""

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

from dora_systemd.logfields import Value
from dora_systemd.logs import LineSplitter, jsonl_fields

POLL_SECONDS = 0.05
# What is read before the loop's other work gets its turn, in bytes.
CHUNK = 1 << 16
MAX_ROTATED = 1000
# A line of at most 1 MiB grows up to sixfold when it is escaped.
LINE_LIMIT = 8 << 20

Put = Callable[[dict[str, Value]], None]


class JsonlTail:
    """Follows one file from its beginning.

    path: log_<node>.jsonl, which may not exist yet. put: takes the journal fields of each line.
    is_busy: while it says so nothing is read, the lines stay in the file.
    lost_files: how often dora deleted a rotated file before it was read.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        path: Path,
        put: Put,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        self.path = path
        self.lost_files = 0
        self._loop = loop
        self._put = put
        self._is_busy = is_busy
        self._lines = LineSplitter(LINE_LIMIT)
        self._fd = -1
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to look, every POLL_SECONDS."""
        has_more = not self._is_busy() and self._read_chunk()
        self._timer = self._loop.call_later(0 if has_more else POLL_SECONDS, self.start)

    def drain(self) -> bool:
        """Take all that is there now; whether there was anything."""
        has_any = False
        while self._read_chunk():
            has_any = True
        return has_any

    def close(self) -> None:
        """Take what is there and stop to look."""
        if self._timer is not None:
            self._timer.cancel()
        self.drain()
        for line in self._lines.flush():
            self._put(jsonl_fields(line))
        self._shut()

    def _read_chunk(self) -> bool:
        """Read on, in the next file if this one is at its end; whether there was anything."""
        data = self._read() or (self._go_on() and self._read()) or b""
        for line in self._lines.feed(data):
            self._put(jsonl_fields(line))
        return bool(data)

    def _read(self) -> bytes:
        if self._fd < 0:
            return b""
        if os.lseek(self._fd, 0, os.SEEK_CUR) > os.fstat(self._fd).st_size:
            os.lseek(self._fd, 0, os.SEEK_SET)  # dora 1.0 truncates it when the node restarts
        return os.read(self._fd, CHUNK)

    def _go_on(self) -> bool:
        """Open the file that comes after the one that has been read; whether there is one."""
        chain = self._chain()
        if self._fd < 0:
            return bool(chain) and self._open(chain[-1])
        own = os.fstat(self._fd).st_ino
        inodes = [_inode(path) for path in chain]
        if own not in inodes:
            if not chain:
                return False
            self.lost_files += 1
            return self._open(chain[-1])
        place = inodes.index(own)
        if place == 0:
            return False
        # Written between our last look and the renaming?
        if rest := self._read():
            os.lseek(self._fd, -len(rest), os.SEEK_CUR)
            return True
        return self._open(chain[place - 1])

    def _chain(self) -> list[Path]:
        """The file and its rotated ones, newest first."""
        chain = [self.path]
        for number in range(1, MAX_ROTATED):
            path = self.path.with_name(f"{self.path.stem}.{number}{self.path.suffix}")
            if not path.exists():
                break
            chain.append(path)
        return [path for path in chain if path.exists()]

    def _open(self, path: Path) -> bool:
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return False  # renamed meanwhile: found at the next look
        self._shut()
        self._fd = fd
        return True

    def _shut(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _inode(path: Path) -> int:
    try:
        return path.stat().st_ino
    except OSError:
        return -1
