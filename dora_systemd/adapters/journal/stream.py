"""A running journalctl, for an event loop."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from subprocess import Popen

from dora_systemd.adapters.journal.journalctl import open_journalctl

_CHUNK = 1 << 17


@asynccontextmanager
async def open_stream(
    arguments: Sequence[str],
) -> AsyncIterator[tuple["Popen[bytes]", asyncio.StreamReader]]:
    """A running journalctl, which the block ends, and what it prints.

    Raises DoraSystemdError as open_journalctl() does.
    """
    loop = asyncio.get_running_loop()
    stream = asyncio.StreamReader(_CHUNK, loop)
    protocol = asyncio.StreamReaderProtocol(stream, loop=loop)
    with open_journalctl(arguments) as child:
        assert child.stdout
        transport, _ = await loop.connect_read_pipe(lambda: protocol, child.stdout)
        try:
            yield child, stream
        finally:
            transport.close()
