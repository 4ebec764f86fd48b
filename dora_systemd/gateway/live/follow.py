"""What nodes write, for a page: a little at a time, and never more than it can show."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import check_readable, end_journalctl, open_journalctl
from dora_systemd.adapters.journal.stream import open_stream
from dora_systemd.decisions.gateway.page_messages import LOG_FIELDS, PageMessage, line_values
from dora_systemd.decisions.logs.fields import ExportReader
from dora_systemd.decisions.logs.query import LogQuery, query_arguments
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import find_cell

FIRST_LINES = 200
"""How far back a page sees when it begins to follow."""
MAX_LINES = 400
"""Of one message: a node may write more in that time than anybody reads."""
PAUSE_SECONDS = 0.2
_CHUNK = 1 << 17

Lines = list[dict[str, Any]]


async def follow_lines(
    scope: Scope, message: PageMessage
) -> AsyncGenerator[tuple[Lines, int], None]:
    """Lines as they come, and how many of those before them were too many to be sent.

    Raises DoraSystemdError when the dataflow is not there or the journal is closed to us.
    """
    query = await asyncio.to_thread(_query, scope, message)
    arguments = [f"--output-fields={LOG_FIELDS}", *query_arguments(query)]
    with open_journalctl(arguments) as child:
        assert child.stdout
        async with open_stream(child.stdout) as stream:
            async for lines in _batches(stream):
                yield lines
        end_journalctl(child)


async def _batches(stream: asyncio.StreamReader) -> AsyncIterator[tuple[Lines, int]]:
    """What comes in PAUSE_SECONDS as one, as long as anything comes."""
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


def _query(scope: Scope, message: PageMessage) -> LogQuery:
    check_readable(scope)
    cell = find_cell(Bus(scope, for_reading=True), message.dataflow)
    return LogQuery(
        scope,
        name=cell.name,
        nodes=(message.node,) if message.node else (),
        tail=FIRST_LINES,
        is_follow=True,
        want_unprintable=True,
        output="export",
    )


async def _read_until(stream: asyncio.StreamReader, until: float) -> bytes:
    """What comes up to that time of the loop, nothing when nothing does."""
    try:
        async with asyncio.timeout_at(until):
            return await stream.read(_CHUNK)
    except TimeoutError:
        return b""
