"""Reads the nodes' output pipes and writes the lines to the journal.

Each node has two FIFOs, fifo(7). The event loop reads CHUNK bytes of one as soon as it is readable,
and LogQueue sends the entries. If journald refuses an entry, the queue keeps what was just read and
LogPipes stops reading that node's pipes. The pipe fills up, pipe(7), and the node blocks in
write(2). So a line gets lost only to a limit of the node, or if journald does not recover before
close() gives up. An event reports both.

All calls come from the event loop's thread, and only settle() and close() may block. To read a pipe
that the queue has paused would break the bound on memory: only drain() does, up to DRAIN_LIMIT.
"""

import asyncio
import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

from dora_systemd.adapters.logs.held import HeldLines, held_path, read_held
from dora_systemd.adapters.logs.queue import Journal, LogQueue
from dora_systemd.adapters.logs.source import CHUNK, PIPE_SIZE, OnLine, Pipe, Source, fifos
from dora_systemd.decisions.cell.line_rates import LineLimiter, RateLimit, format_rate
from dora_systemd.decisions.logs.journal_events import event_fields
from dora_systemd.decisions.logs.lines import (
    LineEncoder,
    LineSplitter,
    Origin,
    Value,
    dora_log_fields,
    encode_entry,
)
from dora_systemd.decisions.logs.noise import is_end_of
from dora_systemd.decisions.resources.usage import WHOLE_CELL, LineCount
from dora_systemd.paths import CellPaths

# Bytes: a child process that outlives its node may keep writing, and drain() must still return.
DRAIN_LIMIT = 4 * PIPE_SIZE


class LogPipes:
    """Writes the output of all nodes of a cell, and the cell's life events, to the journal.

    origin: of entries that belong to no node. keep: called with each pipe that must survive this
    process, and its node; release: called with a node that does not come back.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        journal: Journal,
        origin: Origin,
        keep: Callable[[int, str], object] = lambda *_: None,
        release: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._loop, self._journal = loop, journal
        self._keep, self._release = keep, release
        self._queue = LogQueue(loop, journal, self._pause, self._resume)
        self._origin = origin
        self._paths: dict[str, CellPaths] = {}
        self._sources: dict[str, Source] = {}
        self._outputs: dict[int, LineSplitter] = {}
        self._readers: dict[str, tuple[int, OnLine]] = {}  # file descriptor and on_line, by label
        self.left_out: tuple[bytes, ...] = ()  # lines that contain one of these are left out
        self._muted: frozenset[str] = frozenset()
        self._asked: set[str] = set()  # nodes whose end was requested
        self._expected: tuple[str, ...] = ()  # beginnings of the ids of further ones
        self._lost = 0

    def make(self, node_id: str, paths: CellPaths) -> None:
        """Create the two FIFOs of a node, mode 0600, unless it has them already. Raises OSError."""
        if node_id in self._paths:
            return
        for path in fifos(node_id, paths).values():
            path.unlink(missing_ok=True)
            os.mkfifo(path, 0o600)
        self._paths[node_id] = paths

    def limit(self, node_id: str, limit: RateLimit | None) -> None:
        """Limit the rate of a node's lines from now on; an event counts the suppressed ones."""
        before = self._sources[node_id].limit if node_id in self._sources else None
        if limit != before:
            self._tell_suppressed(node_id)  # by the limit that has suppressed them
            self._source(node_id).limiter = LineLimiter(limit) if limit else None

    def open(self, node_id: str) -> None:
        """Start reading a node's FIFOs, which unblocks its launcher's open(2). Raises OSError."""
        if self._source(node_id).pipes:
            return
        for stream, path in fifos(node_id, self._paths[node_id]).items():
            # With the write end open here too, there is no end of file between two processes.
            fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            self._keep(fd, node_id)
            self.adopt(node_id, stream, fd, HeldLines(path))

    def forget(self, node_id: str) -> None:
        """Drain, close and remove the pipes of a node that does not come back."""
        self._source(node_id).drained = 0  # nothing can stay in a pipe that is removed
        self.drain(node_id)
        source = self._sources.pop(node_id)
        if source.pipes:
            self._release(node_id)
        self._close_pipes(source)
        if node_id in self._paths:
            for path in fifos(node_id, self._paths.pop(node_id)).values():
                path.unlink(missing_ok=True)
                held_path(path).unlink(missing_ok=True)

    def adopt(self, node_id: str, stream: str, fd: int, held: HeldLines | None = None) -> None:
        """Start reading `fd`, an open pipe, as stream "stdout" or "stderr" of a node.

        held: keeps bytes that have been read and are not in the journal yet.
        """
        source = self._source(node_id)
        os.set_blocking(fd, False)
        pipe = Pipe(fd, stream, LineEncoder(source.origin, stream), held=held)
        source.pipes.append(pipe)
        if not self._queue.waiting(node_id):
            self._loop.add_reader(fd, self._read_pipe, node_id, pipe)

    def replay(self, node_id: str, path: Path) -> None:
        """Write what a killed runner had read from the FIFO at `path` and not sent to journald.

        Call this right after adopt() of that pipe: these lines are older than those in the pipe.
        """
        pipe = self._source(node_id).pipes[-1]
        data, done = read_held(path)
        lines = pipe.splitter.feed(data)[done:]
        self._queue.put(node_id, lambda: list(map(pipe.encoder.entry, lines)))

    def set_pid(self, node_id: str, pid: int) -> None:
        """Attribute the node's lines to process `pid` from now on; 0: to its next process."""
        self._source(node_id).renew(pid=pid)

    def _learn_pid(self, source: Source) -> None:
        """Read the pid file of the launcher: dora's event comes tens of milliseconds later."""
        node_id = source.origin.node
        if node_id in self._paths:
            with contextlib.suppress(OSError, ValueError):
                source.renew(pid=int(self._paths[node_id].node_pid(node_id).read_text()))

    def set_run(self, run_id: str) -> None:
        """Attribute all lines and events to dora's run `run_id` from now on."""
        self._origin = self._origin._replace(run=run_id)
        for source in self._sources.values():
            source.renew(run=run_id)

    def drain(self, node_id: str, is_live: bool = False) -> None:
        """Queue what is in a node's pipes, before an event.

        is_live: the node may be in the middle of a line. A line is never ended while the rest of it
        may be in the pipe.
        """
        source = self._source(node_id)
        for pipe in source.pipes:
            # Above the limit while journald takes nothing: the lines are safe in the pipe.
            while source.drained < DRAIN_LIMIT:
                data = pipe.read()
                if data or not is_live:
                    self._put(node_id, pipe, data, is_flood=bool(data))
                if not data:
                    break
                source.drained += len(data)
        self._tell_suppressed(node_id)
        if not self._queue.waiting(node_id):
            source.drained = 0

    def write_event(self, name: str, node: str | None = None, **details: Value) -> None:
        """Write the event `name` of logs/journal_events.py after the lines that are queued."""
        if name == "lines-lost" and isinstance(lost := details["count"], int):
            self._lost += lost
        if node and name == "node-asked":
            self._asked.add(node)
        elif name in ("node-ready", "node-crashed"):
            self._asked.discard(node or "")
        fields = event_fields(name, dataflow=self._origin.name, node=node or "", **details)
        if node:
            self._queue.put_record(node, self._entry(fields, node))
        else:
            self._queue.put_event(self._entry(fields, node))

    def write_fields(self, fields: dict[str, Value], node: str) -> None:
        """Write a line of a node that has no pipe here. The queue does not bound these lines.

        The caller must stop reading its source while is_busy() is true.
        """
        source, stream = self._source(node), str(fields.get("DORA_STREAM", "stdout"))
        if source.admit(stream, 1, self._loop.time()):
            source.written += 1
            entry = self._entry(fields, node)
            self._queue.put(node, lambda: [entry])
        self._watch_limit(source, stream)

    def _entry(self, fields: dict[str, Value], node: str | None) -> bytes:
        origin = self._source(node).origin if node else self._origin
        return encode_entry({**origin.fields(), **fields})

    def line_counts(self) -> dict[str, LineCount]:
        """Lines written, suppressed and lost, by node; lost ones have no node: WHOLE_CELL."""
        whole = {WHOLE_CELL: LineCount(lost=self._lost)}
        each = self._sources.items()
        return whole | {node: LineCount(one.written, one.suppressed) for node, one in each}

    @property
    def kept(self) -> list[str]:
        """The nodes with pipes that must survive this process."""
        return [*self._paths]

    def is_busy(self, node: str) -> bool:
        """Whether entries of the node still wait for journald."""
        return self._queue.waiting(node) > 0

    def add_output(self, label: str, fd: int, on_line: OnLine = None, said: bytes = b"") -> None:
        """Read what coordinator or daemon prints after `said`, and close `fd` at the end of it.

        Warnings and errors become records of `label`; on_line gets every line, without newline.
        """
        os.set_blocking(fd, False)
        self._outputs[fd], self._readers[label] = LineSplitter(), (fd, on_line)
        self._loop.add_reader(fd, self._read_output, label, fd, on_line)
        if said:
            self._loop.call_soon(self._read_output, label, fd, on_line, said)

    def read_output(self, label: str) -> None:
        """Read at once what a child has printed, at most a full pipe.

        For a line that explains what is about to be handled, and may still be in the pipe.
        """
        for _ in range(PIPE_SIZE // CHUNK):
            if label not in self._readers or not self._read_output(label, *self._readers[label]):
                return

    def expect_ends(self, prefix: str) -> None:
        """Leave out what dora's daemon prints about the end of nodes whose id begins so."""
        self._expected += (prefix,)

    def mute(self, *labels: str) -> None:
        """Write no records of what these children print; replaces the labels given before."""
        self._muted = frozenset(labels)

    def settle(self, seconds: float = 7.0) -> None:
        """Drain all pipes and block until journald has taken everything, at most `seconds`."""
        for node_id in self._sources:
            self.drain(node_id)
        deadline = time.monotonic() + seconds
        while not self._queue.is_empty and time.monotonic() < deadline:
            self._journal.wait_ready(deadline - time.monotonic())
            self._queue.flush()

    async def wait_empty(self, left: Callable[[], float]) -> None:
        """Wait until the queue is empty or left() gives 0 seconds; the loop keeps running."""
        while not self._queue.is_empty and left() > 0:
            await asyncio.sleep(0.01)

    def close(self, seconds: float = 7.0) -> None:
        """Settle for up to `seconds` and close; an event lines-lost counts what is left."""
        self.settle(seconds)
        if lost := self._queue.give_up():
            self.write_event("lines-lost", count=lost, reason="journald did not take them")
        for source in self._sources.values():
            self._close_pipes(source)
        for fd in list(self._outputs):
            self._end_output(fd)

    def _close_pipes(self, source: Source) -> None:
        for pipe in source.pipes:
            self._loop.remove_reader(pipe.fd)
            pipe.close()
        source.pipes.clear()

    def _source(self, node_id: str) -> Source:
        if node_id not in self._sources:
            self._sources[node_id] = Source(self._origin._replace(node=node_id))
        return self._sources[node_id]

    def _pause(self, node_id: str) -> None:
        for pipe in self._source(node_id).pipes:
            self._loop.remove_reader(pipe.fd)

    def _resume(self, node_id: str) -> None:
        source = self._source(node_id)
        source.drained = 0
        for pipe in source.pipes:
            self._loop.add_reader(pipe.fd, self._read_pipe, node_id, pipe)
        if lost := self._queue.take_lost():
            self.write_event("lines-lost", count=lost, reason="journald was away for too long")

    def _read_pipe(self, node_id: str, pipe: Pipe) -> None:
        data = pipe.read()
        is_flood = pipe.is_flood(len(data), self._loop.time())
        if data:
            source = self._source(node_id)
            if not source.origin.pid:
                self._learn_pid(source)
            self._put(node_id, pipe, data, is_flood)

    def _put(self, node_id: str, pipe: Pipe, data: bytes, is_flood: bool) -> None:
        source = self._source(node_id)
        batch = source.batch(pipe, data, self._loop.time())
        self._queue.put(node_id, batch.entries, is_flood, batch.note)
        self._watch_limit(source, pipe.stream)

    def _watch_limit(self, source: Source, stream: str) -> None:
        """Schedule one lines-suppressed event for the end of the stream's window."""
        limiter = source.limiter
        if limiter is not None and limiter.suppressed and source.report is None:
            tell = self._tell_suppressed
            source.report = self._loop.call_at(limiter.end(stream), tell, source.origin.node)

    def _tell_suppressed(self, node_id: str) -> None:
        source = self._source(node_id)
        if source.report is not None:
            source.report.cancel()
            source.report = None
        if count := source.take_suppressed():
            limit = format_rate(source.limit)
            self.write_event("lines-suppressed", node_id, count=count, limit=limit)

    def _read_output(self, label: str, fd: int, on_line: OnLine, said: bytes = b"") -> bool:
        """Read a chunk of what a child has printed. Return whether there was one."""
        try:
            data = said or os.read(fd, CHUNK)
        except BlockingIOError:
            return False
        for line in self._outputs[fd].feed(data) if data else self._outputs[fd].flush():
            is_muted = label in self._muted or any(map(line.__contains__, self.left_out))
            fields = None if is_muted else dora_log_fields(line)
            if fields and not is_end_of(str(fields["MESSAGE"]), self._asked, self._expected):
                self._queue.put_record(label, self._entry(fields, label))
            if on_line is not None:
                on_line(line.decode("utf-8", "replace"))
        if not data:
            self._end_output(fd)
        return bool(data)

    def _end_output(self, fd: int) -> None:
        self._loop.remove_reader(fd)
        del self._outputs[fd]
        self._readers = {label: one for label, one in self._readers.items() if one[0] != fd}
        os.close(fd)
