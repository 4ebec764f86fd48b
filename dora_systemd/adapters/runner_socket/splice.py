"""Two connections become one: bytes are passed both ways."""

import asyncio
import contextlib
from typing import NamedTuple

_CHUNK = 1 << 16


class Ends(NamedTuple):
    """The two streams of one connection."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter


async def splice(one: Ends, other: Ends) -> None:
    """Pass bytes between the two until either has no more; then both are closed.

    Never more than a chunk and a buffer of them is held: who does not read makes the other wait.
    """
    ways = ((one.reader, other.writer), (other.reader, one.writer))
    tasks = [asyncio.ensure_future(_pass(*way)) for way in ways]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        one.writer.close()
        other.writer.close()


async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()
