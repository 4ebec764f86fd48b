"""The lines of a dataflow for a page, within limits: a stream, or the newest that match."""

import asyncio
import re
import time
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.journalctl import end_journalctl
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.adapters.journal.stream import open_stream
from dora_systemd.decisions.gateway.page_messages import LOG_FIELDS, PageMessage, line_values
from dora_systemd.decisions.logs.lines import ExportReader
from dora_systemd.decisions.logs.query import LogQuery, query_arguments
from dora_systemd.decisions.logs.records import lines_elsewhere
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.recorded import find_query
from dora_systemd.verbs.facts.selector import Selector

FIRST_LINES = 200
"""Number of older lines that a page gets first."""
MAX_LINES = 400
"""Maximum lines in one message: a node can write more than anyone can read."""
PAUSE_SECONDS = 0.2
MAX_FOUND = 1000
"""Maximum lines of a search: as many as a page keeps."""
MAX_SAVED = 50_000
"""Maximum lines of a file."""
FIND_SECONDS = 20.0
"""Timeout of a search: journalctl looks through the whole journal for a rare word."""
_MAX_BYTES = 32 * 1024 * 1024
_CHUNK = 1 << 17

Lines = list[dict[str, Any]]


def log_query(scope: Scope, message: PageMessage) -> tuple[LogQuery, Lines]:
    """Return the query for a dataflow's or a node's records, and notes about missing machines.

    Raises DoraSystemdError.
    """
    check_readable(scope)
    cells = read_cells(Bus(scope, for_reading=True))
    wanted = Selector(message.dataflow)
    ended = None if wanted.meant(cells) else wanted.ended(scope)
    notes: Lines = []
    if ended is not None:
        # The name may have been used again.
        query = LogQuery(scope, name=ended.name, uuid=ended.uuid)
    else:
        cell = wanted.loaded(cells)
        query = LogQuery(scope, name=cell.name)
        notes = _notes(cell, message.node)
    nodes = (message.node,) if message.node else ()
    return replace(query, nodes=nodes, want_unprintable=True, output="export"), notes


def _notes(cell: Cell, node: str) -> Lines:
    placed = () if cell.options.machine else cell.options.placed
    records = lines_elsewhere(cell.name, placed, node, time.time_ns() // 1000)
    return list(map(line_values, records))


async def follow_lines(
    scope: Scope, message: PageMessage
) -> AsyncGenerator[tuple[Lines, int], None]:
    """New lines in batches, and how many lines before each batch were left out.

    Raises DoraSystemdError if the dataflow does not exist or the journal is not readable.
    """
    query, notes = await asyncio.to_thread(log_query, scope, message)
    query = replace(query, tail=str(FIRST_LINES), is_follow=True)
    if notes:
        yield notes, 0
    arguments = [f"--output-fields={LOG_FIELDS}", *query_arguments(query)]
    async with open_stream(arguments) as (child, stream):
        async for lines in _batches(stream):
            yield lines
        end_journalctl(child)


async def _batches(stream: asyncio.StreamReader) -> AsyncIterator[tuple[Lines, int]]:
    """Batches of the lines of PAUSE_SECONDS each, until the stream ends."""
    newest: deque[dict[str, bytes]] = deque(maxlen=MAX_LINES)
    reader = ExportReader()
    while data := await stream.read(_CHUNK):
        count, until = 0, asyncio.get_running_loop().time() + PAUSE_SECONDS
        while data:
            records = reader.feed(data)
            newest.extend(records)
            count += len(records)
            data = await _read_until(stream, until)
        if newest:
            yield list(map(line_values, newest)), count - len(newest)
        newest.clear()


async def _read_until(stream: asyncio.StreamReader, until: float) -> bytes:
    """The bytes that arrive up to that time of the loop, or b""."""
    try:
        async with asyncio.timeout_at(until):
            return await stream.read(_CHUNK)
    except TimeoutError:
        return b""


async def find_lines(scope: Scope, message: PageMessage, most: int) -> tuple[Lines, bool]:
    """The newest `most` lines that match, oldest first, and whether these are all.

    Raises DoraSystemdError: USAGE for a time that journalctl does not accept.
    """
    query, notes = await asyncio.to_thread(_query, scope, message)
    arguments = [f"--output-fields={LOG_FIELDS}", *query_arguments(query)]
    reader, found, size, is_whole = ExportReader(), Lines(), 0, False
    with suppress(TimeoutError):
        async with asyncio.timeout(FIND_SECONDS), open_stream(arguments) as (child, stream):
            while len(found) <= most and size <= _MAX_BYTES and not is_whole:
                data = await stream.read(_CHUNK)
                found += map(line_values, reader.feed(data))
                size += len(data)
                is_whole = not data
            if is_whole:
                end_journalctl(child)
    return [*notes, *found[:most][::-1]], is_whole and len(found) <= most


def _query(scope: Scope, message: PageMessage) -> tuple[LogQuery, Lines]:
    query, notes = log_query(scope, message)
    query = replace(
        query,
        since=message.since,
        until=message.until,
        # People look for a text; journalctl ignores case if there is no capital in it.
        grep=re.escape(message.search),
        is_reverse=True,
    )
    return find_query(JournalReader(), query, (), (), message.run or "ALL"), notes
