"""Logs and LogSubscribe of dora's protocol, from the journal.

The dora command requests Logs for each node, sorts and filters them itself, and then subscribes.
The connection remembers the last record that it sent, so that no line is missing or doubled between
the two requests.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import suppress

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.journalctl import journal_output
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.adapters.journal.stream import open_stream
from dora_systemd.decisions.gateway.answers import is_from_systemd, is_wanted, log_line
from dora_systemd.decisions.gateway.frames import LOGS_LIMIT, Request, format_event, logs_parts
from dora_systemd.decisions.logs.lines import ExportReader
from dora_systemd.decisions.logs.query import end_matches, journal_timestamp, scope_matches
from dora_systemd.decisions.logs.records import (
    LOG_FIELDS,
    Record,
    lines_elsewhere,
    log_payload,
    record_text,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control import state
from dora_systemd.gateway.control.session import Place, Result, Talk, find_if_loaded
from dora_systemd.names import did_you_mean
from dora_systemd.scope import Scope
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.follow import is_unit_up

_CHUNK = 1 << 18
_EXPORT = ("--output=export", "--quiet", "--all", f"--output-fields={','.join(LOG_FIELDS)}")
_LINES = ("DORA_STREAM=stdout", "DORA_STREAM=stderr")
_CUT_NOTE = "earlier lines are skipped here; all lines: doractl logs {name} --node {node}"
_SETTLE_SECONDS = 0.3
"""Time after the end of a unit for systemd to start it again, if it does."""
_LAST_LINES_SECONDS = 10.0


async def send_logs(talk: Talk, request: Request) -> Result:
    """Logs. Raises DoraSystemdError (NOT_FOUND)."""
    node = request.text("node")
    uuid, lines, place = await asyncio.to_thread(_read_logs, talk.scope, request, node)
    talk.places.setdefault(uuid, {})[node] = place
    await talk.socket.send(_yielding(logs_parts(request.id, lines)))
    return None


async def _yielding(parts: Iterator[str]) -> AsyncIterator[str]:
    for part in parts:
        yield part
        await asyncio.sleep(0)


def _read_logs(scope: Scope, request: Request, node: str) -> tuple[str, list[bytes], Place]:
    now = time.time_ns() // 1000
    uuid = _uuid_of(scope, request)
    name = state.find_name(scope, uuid)
    matches = [*scope_matches(scope, name), f"DORA_DATAFLOW={uuid}", f"DORA_NODE={node}", *_LINES]
    tail = [] if request.tail is None else [f"--lines={request.tail}"]
    lines: list[bytes] = []
    size, place = 0, (now, 0)
    for record in _records([*_EXPORT, "--reverse", *tail, "--", *matches]):
        if not lines:
            place = _place(record)
        lines.append(log_line(record))
        size += len(lines[-1])
        if size > LOGS_LIMIT:
            note = _CUT_NOTE.format(name=name, node=node).encode()
            lines[-1] = log_line({**record, "MESSAGE": note, "DORA_LEVEL": b"warn"})
            break
    if not lines:
        _check_node(scope, uuid, name, node)
    return uuid, [*lines[::-1], *map(log_line, _elsewhere(scope, uuid, node, now))], place


def _elsewhere(scope: Scope, uuid: str, node: str, now: int) -> list[Record]:
    """Return records that name other machines with lines, if there are any. node: "" for all."""
    cell = find_if_loaded(scope, uuid)
    if cell is None or cell.options.machine:
        return []
    return lines_elsewhere(cell.name, cell.options.placed, node, now)


def _uuid_of(scope: Scope, request: Request) -> str:
    if request.body.get("uuid") is None:
        return Selector(request.text("name")).find(Bus(scope, for_reading=True)).uuid
    return request.text("uuid").lower()


def _check_node(scope: Scope, uuid: str, name: str, node: str) -> None:
    """Refuse an unknown node; a known node without records is fine."""
    cell = find_if_loaded(scope, uuid)
    known = JournalReader().known_nodes(scope, name)
    known += read_status(scope, cell).nodes if cell else ()
    if node in known:
        return
    raise DoraSystemdError(
        f"cannot find a node {quoted(node)} of dataflow {name}",
        did_you_mean(node, known) or f"nodes: {', '.join(sorted(set(known))) or 'none'}",
        ExitCode.NOT_FOUND,
    )


def _records(arguments: Sequence[str]) -> Iterator[Record]:
    reader = ExportReader()
    for data in journal_output(arguments):
        yield from reader.feed(data)


async def subscribe_logs(talk: Talk, request: Request) -> Result:
    """LogSubscribe: lines and life events from now on. Raises DoraSystemdError (NOT_FOUND).

    For a dataflow that this connection has started: from its start on.
    """
    uuid = request.dataflow
    name = await asyncio.to_thread(state.find_name, talk.scope, uuid)
    since = talk.started.get(uuid, time.time_ns() // 1000)
    follower = Follower(talk, uuid, name, since, request.body.get("level"))
    talk.after_reply(follower.run())
    talk.followed[uuid] = follower.done
    return {"subscribed": True}


async def check(talk: Talk, request: Request) -> Result:
    """Check. Raises DoraSystemdError (NOT_FOUND).

    A client that follows the dataflow leaves at the reply about its end, so the last lines go
    first.
    """
    reply = await asyncio.to_thread(state.check, talk.scope, request.dataflow)
    done = talk.followed.get(request.dataflow)
    if done is not None and "DataflowSpawned" not in reply:
        with suppress(TimeoutError):
            async with asyncio.timeout(_LAST_LINES_SECONDS):
                await done.wait()
    return reply


class Follower:
    """Sends the lines of a dataflow until it has ended and waits for no restart.

    since_us: CLOCK_REALTIME µs. level: dora's name of a level, see is_wanted.
    """

    def __init__(self, talk: Talk, uuid: str, name: str, since_us: int, level: object) -> None:
        self._talk, self._uuid, self._name, self._level = talk, uuid, name, level
        self._since = (since_us, 0)
        self._places = talk.places.get(uuid, {})
        self.done = asyncio.Event()

    async def run(self) -> None:
        """Send everything, then close a connection that has no other purpose."""
        try:
            await self._follow()
        finally:
            self.done.set()

    async def _follow(self) -> None:
        scope = self._talk.scope
        first = min([self._since, *self._places.values()])[0]
        matches = [*scope_matches(scope, self._name), f"DORA_DATAFLOW={self._uuid}"]
        matches += ["+", *end_matches(scope, self._name)]
        since = f"--since={journal_timestamp(first)}"
        async with open_stream([*_EXPORT, "--follow", since, "--", *matches]) as (_, stream):
            if self._uuid in self._talk.started or await self._is_up():
                await self._send_elsewhere()
                await self._send_all(stream)
        if self._uuid not in self._talk.started:
            await self._talk.socket.close()

    async def _send_elsewhere(self) -> None:
        now = time.time_ns() // 1000
        for record in await asyncio.to_thread(_elsewhere, self._talk.scope, self._uuid, "", now):
            await self._talk.socket.send(format_event(log_payload(record, self._uuid)))

    async def _send_all(self, stream: asyncio.StreamReader) -> None:
        records = ExportReader()
        while data := await stream.read(_CHUNK):
            for record in records.feed(data):
                if is_from_systemd(record):
                    await asyncio.sleep(_SETTLE_SECONDS)
                    if not await self._is_up():
                        return
                elif self._is_new(record) and is_wanted(record, self._level):
                    payload = log_payload(record, self._uuid)
                    await self._talk.socket.send(format_event(payload))

    def _is_new(self, record: Record) -> bool:
        return _place(record) > self._places.get(record_text(record, "DORA_NODE"), self._since)

    async def _is_up(self) -> bool:
        return await asyncio.to_thread(
            lambda: is_unit_up(Bus(self._talk.scope, for_reading=True), self._name)
        )


def _place(record: Record) -> Place:
    return int(record["__REALTIME_TIMESTAMP"]), int(record.get("__SEQNUM", b"0"))
