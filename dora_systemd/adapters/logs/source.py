"""What comes out of one node: its pipes, the lines in them, and how many of these may pass."""

import asyncio
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dora_systemd.adapters.logs.held import HeldLines
from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.decisions.cell.status import LineCount
from dora_systemd.decisions.logs.limiter import LineLimiter
from dora_systemd.decisions.logs.lines import LineEncoder, LineSplitter, Origin
from dora_systemd.paths import CellPaths

# Linux's default, and enough: in a bigger pipe bursts pass faster, but at the end of the cell
# journald has to take what is in all pipes before the unit may end. See pipe(7).
PIPE_SIZE = 1 << 16
# What is read of one pipe before the others get their turn: about 1 ms of lines.
CHUNK = 1 << 13
# A pipe that gives more bytes than this in so many seconds is a flood: it yields to the others.
FLOOD_BYTES = 1 << 14
FLOOD_SECONDS = 0.1


@dataclass
class Pipe:
    """One stream of a node. fd: not blocking. since, taken: of is_flood()."""

    fd: int
    stream: str
    encoder: LineEncoder
    splitter: LineSplitter = field(default_factory=LineSplitter)
    since: float = 0.0
    taken: int = 0
    # Where what is on its way is noted; how many batches that is, and lines of earlier ones.
    held: HeldLines | None = None
    batches: int = 0
    noted: int = 0
    # Whether the last line has not ended.
    is_open: bool = False
    # Lines that journald has taken.
    written: int = 0

    def read(self) -> bytes:
        """What is in the pipe, CHUNK bytes at most."""
        try:
            return os.read(self.fd, CHUNK) if self.held is None else self.held.take(self.fd, CHUNK)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close it, and what is noted of it."""
        os.close(self.fd)
        if self.held is not None:
            self.held.close()

    def is_flood(self, size: int, now: float) -> bool:
        """Whether the pipe, which has just given `size` bytes, floods; `now` in seconds."""
        if now - self.since > FLOOD_SECONDS:
            self.since, self.taken = now, 0
        self.taken += size
        return self.taken > FLOOD_BYTES

    def lines(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes; no data: the line that nothing will."""
        return self.splitter.feed(data) if data else self.splitter.flush()

    def take(self, data: bytes) -> None:
        """A batch with `data`, just read, is to come; none: nothing ends the line."""
        self.batches += 1
        if data:
            self.is_open = data[-1:] != b"\n"
        elif self.is_open:
            self.is_open = False
            if self.held is not None:
                self.held.add(b"\n")

    def note_part(self, lines: int) -> None:
        """Journald has so many lines of the batch whose turn it is."""
        if self.held is not None:
            self.held.sent(self.noted + lines)

    def note_all(self, lines: int) -> None:
        """Journald has all of it, which is `lines`."""
        self.batches -= 1
        self.noted += lines
        if self.held is None:
            return
        if self.batches or not self.held.restart(self.splitter.rest):
            self.note_part(0)
        else:
            self.noted = 0


@dataclass
class Source:
    """A node, its pipes, and its limit if it has one."""

    origin: Origin
    pipes: list[Pipe] = field(default_factory=list)
    # Bytes that drain() took since journald last had everything.
    drained: int = 0
    limiter: LineLimiter | None = None
    # When what the limiter took is told.
    report: asyncio.TimerHandle | None = None
    # Lines that did not come by a pipe, and those that the limiter took and that were told.
    written: int = 0
    suppressed: int = 0

    def limit(self, limit: RateLimit) -> None:
        """Keep only so many of its lines from now on."""
        self.limiter = LineLimiter(limit)

    @property
    def line_count(self) -> LineCount:
        """What became of its lines so far."""
        piped = sum(pipe.written for pipe in self.pipes)
        return LineCount(self.written + piped, self.suppressed)

    def renew(self, **changes: Any) -> None:
        """Change the origin, of this node's next lines too."""
        self.origin = replace(self.origin, **changes)
        for pipe in self.pipes:
            pipe.encoder = LineEncoder(self.origin, pipe.stream)

    def batch(self, pipe: Pipe, data: bytes, now: float) -> "LineBatch":
        """The entries of the lines that `data` of `pipe` completes; `now` in seconds."""
        pipe.take(data)
        if self.limiter is None:
            return LineBatch(pipe, data)
        lines = pipe.lines(data)
        return LineBatch(pipe, data, lines, self.admit(pipe.stream, len(lines), now))

    def admit(self, stream: str, count: int, now: float) -> int:
        """How many of `count` lines that have come at `now`, in seconds, may pass."""
        return count if self.limiter is None else self.limiter.admit(stream, count, now)


class LineBatch:
    """Entries on their way. They are made late, because what waits for journald should be small.

    data: what was read of `pipe`. lines, passed: of a node with a limit, whose lines had to be
    looked at already: those of `data`, and how many of them are sent.
    """

    def __init__(
        self, pipe: Pipe, data: bytes, lines: list[bytes] | None = None, passed: int = 0
    ) -> None:
        self._pipe = pipe
        self._encoder = pipe.encoder
        self._data = data
        self._lines = lines
        self._passed = passed
        self._count = 0

    def entries(self) -> list[bytes]:
        """Make them."""
        lines = self._pipe.lines(self._data) if self._lines is None else self._lines
        self._count = len(lines)
        if self._lines is None:
            self._passed = self._count
        return list(map(self._encoder.entry, lines[: self._passed]))

    def note(self, left: int) -> None:
        """Journald has taken all but the last `left` entries."""
        if left:
            self._pipe.note_part(self._passed - left)
        else:
            self._pipe.written += self._passed
            self._pipe.note_all(self._count)


def fifos(node_id: str, paths: CellPaths) -> dict[str, Path]:
    """The two FIFOs of a node by stream."""
    return {"stdout": paths.node_stdout(node_id), "stderr": paths.node_stderr(node_id)}
