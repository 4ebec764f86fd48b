"""dora's own log file of a node, followed: for nodes whose output dora's daemon must read itself.

The daemon appends to log_<node>.jsonl, over restarts too, and may rotate it: then it is renamed
to log_<node>.1.jsonl, that one to .2, and so on. Rotations are found by inode, so nothing is
read twice or passed over as long as dora keeps one file more than was written between two looks.
"""

import asyncio
import contextlib
import os
from collections.abc import Callable
from pathlib import Path

from dora_systemd.decisions.logs.fields import Value
from dora_systemd.decisions.logs.lines import LineSplitter, jsonl_fields

POLL_SECONDS = 0.05
# What is read before the loop's other work gets its turn, in bytes.
CHUNK = 1 << 16
MAX_ROTATED = 1000
# A line of at most 1 MiB grows up to sixfold when it is escaped.
LINE_LIMIT = 8 << 20

PLACE_SUFFIX = ".place"

Put = Callable[[dict[str, Value]], None]


class JsonlTail:
    """Follows one file from its beginning.

    path: log_<node>.jsonl, which may not exist yet. put: takes the journal fields of each line.
    is_busy: while it says so nothing is read, the lines stay in the file.
    place: where to note how far the journal has the lines; see resume_tail().
    watch: is told at each look how many bytes are there that were not read.
    lost_files: how often dora deleted a rotated file before it was read.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        path: Path,
        put: Put,
        is_busy: Callable[[], bool] = lambda: False,
        place: Path | None = None,
        watch: Callable[[int], None] = lambda _: None,
    ) -> None:
        self.path = path
        self.lost_files = 0
        self._loop = loop
        self._put = put
        self._is_busy = is_busy
        self._watch = watch
        self._lines = LineSplitter(LINE_LIMIT)
        self._fd = -1
        self._timer: asyncio.TimerHandle | None = None
        self._place = _Place(place, path) if place is not None else None

    def start(self) -> None:
        """Begin to look, every POLL_SECONDS."""
        self._note_place()
        is_busy = self._is_busy()
        has_more = not is_busy and self._read_chunk() > 0
        self._note_place()
        self._watch(self.backlog() if is_busy or has_more else 0)
        self._timer = self._loop.call_later(0 if has_more else POLL_SECONDS, self.start)

    def drain(self) -> bool:
        """Take all that is there now, and no more of a flood; whether there was anything."""
        left = whole = self.backlog()
        while left > 0 and (size := self._read_chunk()):
            left -= size
        return left < whole

    def close(self) -> None:
        """Take what is there and stop to look."""
        if self._timer is not None:
            self._timer.cancel()
        while self._read_chunk():
            pass
        for line in self._lines.flush():
            self._put(jsonl_fields(line))
        self._shut()
        if self._place is not None:
            self._place.close()

    @property
    def loss(self) -> str:
        """Why lines are lost, "" if none are. How many nobody knows: dora does not count them."""
        if not self.lost_files:
            return ""
        return f"dora deleted {self.lost_files} of its log files before they were read"

    def backlog(self) -> int:
        """How many bytes dora has written that were not read."""
        own, total = None, 0
        if self._fd >= 0:
            own, place = os.fstat(self._fd), os.lseek(self._fd, 0, os.SEEK_CUR)
            total = own.st_size - (place if place <= own.st_size else 0)
        for path in self._chain():
            with contextlib.suppress(OSError):
                status = path.stat()
                if own and status.st_ino == own.st_ino:
                    break
                total += status.st_size
        return total

    def resume(self, inode: int, offset: int) -> None:
        """Begin with byte `offset` of the file `inode`, if it is still there."""
        for path in self._chain():
            if _inode(path) == inode and self._open(path):
                os.lseek(self._fd, offset, os.SEEK_SET)

    def _note_place(self) -> None:
        if self._place is not None and self._fd >= 0 and not self._is_busy():
            offset = os.lseek(self._fd, 0, os.SEEK_CUR) - len(self._lines.rest)
            self._place.note(os.fstat(self._fd).st_ino, offset)

    def _read_chunk(self) -> int:
        """Read on, in the next file if this one is at its end; how many bytes there were."""
        data = self._read() or (self._go_on() and self._read()) or b""
        for line in self._lines.feed(data):
            self._put(jsonl_fields(line))
        return len(data)

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


class _Place:
    """Inode and offset in a file that outlives this process, with the path of what they are in."""

    def __init__(self, path: Path, log: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        self._log = log
        self._noted = (0, -1)

    def note(self, inode: int, offset: int) -> None:
        if self._noted != (inode, offset):
            self._noted = (inode, offset)
            with contextlib.suppress(OSError):
                # One call and always of one length: there is no half of it.
                os.pwrite(self._fd, b"%020d %020d %s" % (inode, offset, bytes(self._log)), 0)

    def close(self) -> None:
        os.close(self._fd)


def resume_tail(loop: asyncio.AbstractEventLoop, place: Path, put: Put) -> JsonlTail | None:
    """What follows the file that another process followed, from the place that it noted.

    None if it had read nothing.
    """
    words = place.read_bytes().split(b" ", 2)
    if len(words) != 3:
        return None
    tail = JsonlTail(loop, Path(os.fsdecode(words[2])), put)
    tail.resume(int(words[0]), int(words[1]))
    return tail


def _inode(path: Path) -> int:
    try:
        return path.stat().st_ino
    except OSError:
        return -1
