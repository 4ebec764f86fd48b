"""The output of one node: its pipes, their lines, and the node's rate limit."""

import asyncio
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dora_systemd.adapters.logs.held import HeldLines
from dora_systemd.decisions.cell.line_rates import LineLimiter, RateLimit
from dora_systemd.decisions.logs.lines import LineEncoder, LineSplitter, Origin
from dora_systemd.paths import CellPaths

# Linux's default. A larger pipe would take bursts faster, but at the end of the cell journald must
# take the content of all pipes before the unit can end. See pipe(7).
PIPE_SIZE = 1 << 16
# Bytes to read from one pipe before the others get their turn: about 1 ms of lines.
CHUNK = 1 << 13
# A pipe with more bytes than this in so many seconds counts as a flood, and yields to others.
FLOOD_BYTES = 1 << 14
FLOOD_SECONDS = 0.1

OnLine = Callable[[str], None] | None
"""Gets every line of an output, without newline."""


@dataclass
class Pipe:
    """One stream of a node."""

    fd: int  # non-blocking
    stream: str
    encoder: LineEncoder
    splitter: LineSplitter = field(default_factory=LineSplitter)
    # since, taken: for is_flood()
    since: float = 0.0
    taken: int = 0
    # Keeps the bytes that journald does not have; number of such batches.
    held: HeldLines | None = None
    batches: int = 0
    # Whether the last line is unterminated.
    is_open: bool = False

    def read(self) -> bytes:
        """Read at most CHUNK bytes; b"" if the pipe is empty."""
        try:
            return os.read(self.fd, CHUNK) if self.held is None else self.held.take(self.fd, CHUNK)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close the pipe, and the file of held bytes."""
        os.close(self.fd)
        if self.held is not None:
            self.held.close()

    def is_flood(self, size: int, now: float) -> bool:
        """Whether the pipe floods, after a read of `size` bytes; `now` in seconds."""
        if now - self.since > FLOOD_SECONDS:
            self.since, self.taken = now, 0
        self.taken += size
        return self.taken > FLOOD_BYTES

    def lines(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes; without data: the unterminated line."""
        return self.splitter.feed(data) if data else self.splitter.flush()

    def take(self, data: bytes) -> None:
        """Announce a batch with `data`, just read; no data: the end of an unterminated line."""
        self.batches += 1
        if data:
            self.is_open = data[-1:] != b"\n"
        elif self.is_open:
            self.is_open = False
            if self.held is not None:
                self.held.add(b"\n")


@dataclass
class Source:
    """A node, its pipes, and its rate limit if it has one."""

    origin: Origin
    pipes: list[Pipe] = field(default_factory=list)
    # Bytes that drain() has read since journald last had everything.
    drained: int = 0
    limiter: LineLimiter | None = None
    # The timer of the event about suppressed lines.
    report: asyncio.TimerHandle | None = None
    # Number of lines written, and of suppressed lines that were reported.
    written: int = 0
    suppressed: int = 0

    @property
    def limit(self) -> RateLimit | None:
        return self.limiter.limit if self.limiter else None

    def take_suppressed(self) -> int:
        """Return the number of suppressed lines that no event has reported yet, and reset it."""
        count = self.limiter.take_suppressed() if self.limiter else 0
        self.suppressed += count
        return count

    def renew(self, **changes: Any) -> None:
        """Change the origin of the node's later lines."""
        self.origin = self.origin._replace(**changes)
        for pipe in self.pipes:
            pipe.encoder = LineEncoder(self.origin, pipe.stream)

    def batch(self, pipe: Pipe, data: bytes, now: float) -> "LineBatch":
        """The entries of the lines that `data` of `pipe` completes; `now` in seconds."""
        pipe.take(data)
        batch = LineBatch(self, pipe, pipe.encoder, data)
        if self.limiter is not None:
            lines = pipe.lines(data)
            batch.lines = lines[: self.admit(pipe.stream, len(lines), now)]
            batch.suppressed = len(lines) - len(batch.lines)
        return batch

    def admit(self, stream: str, count: int, now: float) -> int:
        """Return how many of `count` lines may pass that arrived at `now` (seconds) may pass."""
        return count if self.limiter is None else self.limiter.admit(stream, count, now)


@dataclass
class LineBatch:
    """The entries of one read. They are made late, because raw bytes take less memory."""

    source: Source
    pipe: Pipe
    encoder: LineEncoder
    data: bytes  # what was read from `pipe`
    # lines, suppressed: for a node with a rate limit, which had to count the lines at once: the
    # lines of `data` that may pass, and the number of the others
    lines: list[bytes] | None = None
    suppressed: int = 0
    passed: int = 0

    def entries(self) -> list[bytes]:
        lines = self.pipe.lines(self.data) if self.lines is None else self.lines
        self.passed = len(lines)
        return list(map(self.encoder.entry, lines))

    def note(self, left: int) -> None:
        """Record that journald has taken all but the last `left` entries."""
        held = self.pipe.held
        if not left:
            self.source.written += self.passed
            self.pipe.batches -= 1
            if held is not None:
                rest = None if self.pipe.batches else self.pipe.splitter.rest
                held.sent_all(self.passed + self.suppressed, rest)
        elif held is not None:
            held.sent(self.passed - left)


def fifos(node_id: str, paths: CellPaths) -> dict[str, Path]:
    """The two FIFOs of a node by stream."""
    return {"stdout": paths.node_stdout(node_id), "stderr": paths.node_stderr(node_id)}
