"""Follows dora's own log file of a node, for nodes whose output dora's daemon reads itself.

The daemon appends to log_<node>.jsonl, over restarts too. It may rotate the file: then it becomes
log_<node>.1.jsonl, that one .2, and so on. The inodes show a rotation. No line is read twice or
missed as long as dora keeps one file more than it fills between two reads.

A file is polled while dora writes to it: to be woken by each write would cost more. A file that
rests is read again when wake() is called, after the next change.
"""

import asyncio
import contextlib
import os
from collections.abc import Callable
from pathlib import Path

from dora_systemd.decisions.logs.lines import LineSplitter, Value, jsonl_fields

POLL_SECONDS = 0.05
QUIET_POLLS = 20
"""Polls without anything new after which a file rests."""
# Bytes to read before the loop does other work.
CHUNK = 1 << 16
MAX_ROTATED = 1000
# Escaping makes a line of at most 1 MiB up to six times longer.
LINE_LIMIT = 8 << 20

PLACE_SUFFIX = ".place"
_PLACE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC

Put = Callable[[dict[str, Value]], None]


class JsonlTail:
    """Follows one file from its beginning.

    path: log_<node>.jsonl, which may not exist yet. put: called with the journal fields of each
    line. is_busy: while true nothing is read, and the lines stay in the file. place: a file that
    notes up to where the journal has the lines; see resume_tail(). watch: called at each read with
    the number of unread bytes. lost_files: how often dora deleted a rotated file before it was
    read. rests: whether nothing is read before wake(). on_quiet: called before the file rests;
    whether wake() is called after any change that follows.
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
        self.on_quiet: Callable[[], bool] = lambda: False
        self._quiet_polls, self._is_watched, self.rests = 0, False, False
        self._place = -1 if place is None else os.open(place, _PLACE_FLAGS, 0o600)
        self._noted = b""

    def start(self) -> None:
        """Start reading every POLL_SECONDS."""
        self._note_place()
        is_busy = self._is_busy()
        has_more = not is_busy and self._read_chunk() > 0
        self._note_place()
        self._watch(self.backlog() if is_busy or has_more else 0)
        self.rests = self._may_rest(is_quiet=not (is_busy or has_more))
        if not self.rests:
            self._timer = self._loop.call_later(0 if has_more else POLL_SECONDS, self.start)

    def wake(self) -> None:
        """Read on, because dora may have written something."""
        self._quiet_polls = 0
        if self.rests:
            self.start()

    def _may_rest(self, is_quiet: bool) -> bool:
        """Whether this poll is the last one. One more follows on_quiet(), so nothing is missed."""
        self._quiet_polls = self._quiet_polls + 1 if is_quiet else 0
        if self._quiet_polls == QUIET_POLLS:
            self._is_watched = self.on_quiet()
        elif self._quiet_polls > QUIET_POLLS:
            self._quiet_polls = 0
            return self._is_watched
        return False

    def drain(self) -> bool:
        """Read what the file contains now, within a limit; return whether there was anything."""
        left = whole = self.backlog()
        while left > 0 and (size := self._read_chunk()):
            left -= size
        return left < whole

    def close(self) -> None:
        """Read what the file contains, and stop following it."""
        self.rests = False
        if self._timer is not None:
            self._timer.cancel()
        while self._read_chunk():
            pass
        for line in self._lines.flush():
            self._put(jsonl_fields(line))
        self._shut()
        if self._place >= 0:
            os.close(self._place)
            self._place = -1

    @property
    def loss(self) -> str:
        """The reason why lines are lost, or "". dora does not count lost lines."""
        if not self.lost_files:
            return ""
        return f"dora deleted {self.lost_files} of its log files before they were read"

    def backlog(self) -> int:
        """Number of unread bytes that dora has written."""
        own, total = None, 0
        if self._fd >= 0:
            own, place = os.fstat(self._fd), os.lseek(self._fd, 0, os.SEEK_CUR)
            total = own.st_size - (place if place <= own.st_size else 0)
        for _, status in self._chain():
            if own and status.st_ino == own.st_ino:
                break
            total += status.st_size
        return total

    def resume(self, inode: int, offset: int) -> None:
        """Begin with byte `offset` of the file `inode`, if that still exists."""
        for path, status in self._chain():
            if status.st_ino == inode and self._open(path):
                os.lseek(self._fd, offset, os.SEEK_SET)

    def _note_place(self) -> None:
        """Write inode and offset of what the journal has, and the path, to the file `place`."""
        if self._place < 0 or self._fd < 0 or self._is_busy():
            return
        inode = os.fstat(self._fd).st_ino
        offset = os.lseek(self._fd, 0, os.SEEK_CUR) - len(self._lines.rest)
        place = b"%020d %020d %s" % (inode, offset, bytes(self.path))
        if place != self._noted:
            self._noted = place
            with contextlib.suppress(OSError):
                # One write of constant length, so it is never half done.
                os.pwrite(self._place, place, 0)

    def _read_chunk(self) -> int:
        """Read on, in the next file at the end of this one; number of bytes read."""
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
        """Open the file after the one that has been read; whether there is one."""
        chain = self._chain()
        if self._fd < 0:
            return bool(chain) and self._open(chain[-1][0])
        own = os.fstat(self._fd).st_ino
        inodes = [status.st_ino for _, status in chain]
        if own not in inodes:
            if not chain:
                return False
            self.lost_files += 1
            return self._open(chain[-1][0])
        place = inodes.index(own)
        if place == 0:
            return False
        # dora may have written this between our last read and the rotation.
        if rest := self._read():
            os.lseek(self._fd, -len(rest), os.SEEK_CUR)
            return True
        return self._open(chain[place - 1][0])

    def _chain(self) -> list[tuple[Path, os.stat_result]]:
        """The file and its rotated ones, newest first."""
        chain = []
        with contextlib.suppress(OSError):
            chain.append((self.path, self.path.stat()))
        with contextlib.suppress(OSError):
            for number in range(1, MAX_ROTATED):
                path = self.path.with_name(f"{self.path.stem}.{number}{self.path.suffix}")
                chain.append((path, path.stat()))
        return chain

    def _open(self, path: Path) -> bool:
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return False  # renamed meanwhile: the next read finds it
        self._shut()
        self._fd = fd
        return True

    def _shut(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def resume_tail(loop: asyncio.AbstractEventLoop, place: Path, put: Put) -> JsonlTail | None:
    """Follow the file of a killed process, from the position that the process recorded.

    None if that process had read nothing.
    """
    words = place.read_bytes().split(b" ", 2)
    if len(words) != 3:
        return None
    tail = JsonlTail(loop, Path(os.fsdecode(words[2])), put)
    tail.resume(int(words[0]), int(words[1]))
    return tail
