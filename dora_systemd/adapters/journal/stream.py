"""What journalctl writes, for an event loop."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import IO

_CHUNK = 1 << 17


@asynccontextmanager
async def open_stream(pipe: IO[bytes]) -> AsyncIterator[asyncio.StreamReader]:
    """What a child writes, for the event loop."""
    loop = asyncio.get_running_loop()
    stream = asyncio.StreamReader(_CHUNK, loop)
    protocol = asyncio.StreamReaderProtocol(stream, loop=loop)
    transport, _ = await loop.connect_read_pipe(lambda: protocol, pipe)
    try:
        yield stream
    finally:
        transport.close()
