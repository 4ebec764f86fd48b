"""What comes out of one node: its pipes, the lines in them, and how many of these may pass."""

import asyncio
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.cellpaths import CellPaths
from dora_systemd.lograte import LineLimiter
from dora_systemd.logs import LineEncoder, LineSplitter, Origin

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

    def read(self) -> bytes:
        """What is in the pipe, CHUNK bytes at most."""
        try:
            return os.read(self.fd, CHUNK)
        except BlockingIOError:
            return b""

    def is_flood(self, size: int, now: float) -> bool:
        """Whether the pipe, which has just given `size` bytes, floods; `now` in seconds."""
        if now - self.since > FLOOD_SECONDS:
            self.since, self.taken = now, 0
        self.taken += size
        return self.taken > FLOOD_BYTES

    def lines(self, data: bytes) -> list[bytes]:
        """The lines that `data` completes; no data: the line that nothing will."""
        return self.splitter.feed(data) if data else self.splitter.flush()


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

    def renew(self, **changes: Any) -> None:
        """Change the origin, of this node's next lines too."""
        self.origin = replace(self.origin, **changes)
        for pipe in self.pipes:
            pipe.encoder = LineEncoder(self.origin, pipe.stream)

    def entries(self, pipe: Pipe, data: bytes, now: float) -> Callable[[], list[bytes]]:
        """What makes the journal entries of the lines that `data` of `pipe` completes.

        `now` in seconds. They are made late, because what waits for journald should be small.
        """
        if self.limiter is None:
            return partial(_entries_of_data, pipe, pipe.encoder, data)
        lines = pipe.lines(data)
        passed = self.admit(pipe.stream, len(lines), now)
        return partial(_entries_of_lines, pipe.encoder, lines[:passed])

    def admit(self, stream: str, count: int, now: float) -> int:
        """How many of `count` lines that have come at `now`, in seconds, may pass."""
        return count if self.limiter is None else self.limiter.admit(stream, count, now)


def _entries_of_data(pipe: Pipe, encoder: LineEncoder, data: bytes) -> list[bytes]:
    return _entries_of_lines(encoder, pipe.lines(data))


def _entries_of_lines(encoder: LineEncoder, lines: list[bytes]) -> list[bytes]:
    return list(map(encoder.entry, lines))


def fifos(node_id: str, paths: CellPaths) -> dict[str, Path]:
    """The two FIFOs of a node by stream."""
    return {"stdout": paths.node_stdout(node_id), "stderr": paths.node_stderr(node_id)}
