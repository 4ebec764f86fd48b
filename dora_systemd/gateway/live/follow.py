"""Streams the lines of nodes to a page in batches, and limits their number."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import replace

from dora_systemd.adapters.journal.journalctl import end_journalctl, open_journalctl
from dora_systemd.adapters.journal.stream import open_stream
from dora_systemd.decisions.gateway.page_messages import LOG_FIELDS, PageMessage, line_values
from dora_systemd.decisions.logs.fields import ExportReader
from dora_systemd.decisions.logs.query import LogQuery, query_arguments
from dora_systemd.gateway.live.find import Lines, log_query
from dora_systemd.scope import Scope

FIRST_LINES = 200
"""Number of older lines that a page gets first."""
MAX_LINES = 400
"""Maximum lines in one message: a node can write more than anyone can read."""
PAUSE_SECONDS = 0.2
_CHUNK = 1 << 17


async def follow_lines(
    scope: Scope, message: PageMessage
) -> AsyncGenerator[tuple[Lines, int], None]:
    """New lines in batches, and how many lines before each batch were left out.

    Raises DoraSystemdError if the dataflow does not exist or the journal is not readable.
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


def _query(scope: Scope, message: PageMessage) -> LogQuery:
    nodes = (message.node,) if message.node else ()
    query = log_query(scope, message.dataflow)
    return replace(query, nodes=nodes, tail=str(FIRST_LINES), is_follow=True)


async def _read_until(stream: asyncio.StreamReader, until: float) -> bytes:
    """The bytes that arrive up to that time of the loop, or b""."""
    try:
        async with asyncio.timeout_at(until):
            return await stream.read(_CHUNK)
    except TimeoutError:
        return b""
