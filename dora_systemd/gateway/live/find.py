"""Searches the logs of a dataflow for a page: the newest lines that match, within limits."""

import asyncio
import re
from contextlib import suppress
from dataclasses import replace
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.journalctl import end_journalctl, open_journalctl
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.adapters.journal.stream import open_stream
from dora_systemd.decisions.gateway.page_messages import LOG_FIELDS, PageMessage, line_values
from dora_systemd.decisions.logs.fields import ExportReader
from dora_systemd.decisions.logs.query import LogQuery, query_arguments
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.recorded import find_query
from dora_systemd.verbs.facts.selector import Selector

MAX_FOUND = 1000
"""Maximum lines of a search: as many as a page keeps."""
MAX_SAVED = 50_000
"""Maximum lines of a file."""
FIND_SECONDS = 20.0
"""Timeout of a search: journalctl looks through the whole journal for a rare word."""
_MAX_BYTES = 32 * 1024 * 1024
_CHUNK = 1 << 17

Lines = list[dict[str, Any]]


def log_query(scope: Scope, dataflow: str) -> LogQuery:
    """The records of a dataflow, which may have ended. Raises DoraSystemdError."""
    check_readable(scope)
    cells = read_cells(Bus(scope, for_reading=True))
    wanted = Selector(dataflow)
    ended = None if wanted.meant(cells) else wanted.ended(scope)
    if ended is not None:
        # The name may have been used again.
        query = LogQuery(scope, name=ended.name, uuid=ended.uuid)
    else:
        query = LogQuery(scope, name=wanted.loaded(cells).name)
    return replace(query, want_unprintable=True, output="export")


async def find_lines(scope: Scope, message: PageMessage, most: int) -> tuple[Lines, bool]:
    """The newest `most` lines that match, oldest first, and whether these are all.

    Raises DoraSystemdError: USAGE for a time that journalctl does not accept.
    """
    query = await asyncio.to_thread(_query, scope, message)
    reader, found, size, is_whole = ExportReader(), Lines(), 0, False
    with open_journalctl([f"--output-fields={LOG_FIELDS}", *query_arguments(query)]) as child:
        assert child.stdout
        with suppress(TimeoutError):
            async with asyncio.timeout(FIND_SECONDS), open_stream(child.stdout) as stream:
                while len(found) <= most and size <= _MAX_BYTES and not is_whole:
                    data = await stream.read(_CHUNK)
                    found += map(line_values, reader.feed(data))
                    size += len(data)
                    is_whole = not data
        if is_whole:
            end_journalctl(child)
    return found[:most][::-1], is_whole and len(found) <= most


def _query(scope: Scope, message: PageMessage) -> LogQuery:
    query = replace(
        log_query(scope, message.dataflow),
        nodes=(message.node,) if message.node else (),
        since=message.since,
        until=message.until,
        # People look for a text; journalctl ignores case if there is no capital in it.
        grep=re.escape(message.search),
        is_reverse=True,
    )
    return find_query(JournalReader(), query, (), (), message.run or "ALL")
