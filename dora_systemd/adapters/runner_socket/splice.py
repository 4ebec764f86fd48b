"""Connects two connections: passes bytes both ways."""

import asyncio
import contextlib
import socket
from typing import NamedTuple, Protocol

_CHUNK = 1 << 16


class Transport(Protocol):
    """The methods of asyncio.WriteTransport that are used."""

    def abort(self) -> None: ...

    def get_write_buffer_size(self) -> int: ...


class Writer(Protocol):
    """The methods of asyncio.StreamWriter that are used."""

    @property
    def transport(self) -> Transport: ...

    def write(self, data: bytes) -> None: ...

    async def drain(self) -> None: ...

    def is_closing(self) -> bool: ...

    def close(self) -> None: ...


class Ends(NamedTuple):
    """The two streams of one connection."""

    reader: asyncio.StreamReader
    writer: Writer


async def taken_over(connection: socket.socket, said: bytes, limit: int) -> Ends:
    """Wrap a connection that is older than the event loop.

    `said`: the bytes that were already received. limit: maximum bytes of a line.
    """
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit, loop)
    reader.feed_data(said)
    protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
    connection.setblocking(False)
    with contextlib.suppress(OSError):
        # The other side may have ended already: after a failed write its last bytes would be lost.
        reader.feed_data(connection.recv(_CHUNK))
    transport, _ = await loop.connect_accepted_socket(lambda: protocol, connection)
    return Ends(reader, asyncio.StreamWriter(transport, protocol, reader, loop))


async def splice(one: Ends, other: Ends) -> None:
    """Pass bytes between the two until one of them ends; then close both.

    Holds at most a chunk and a buffer: if one side does not read, the other has to wait.
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


async def _pass(reader: asyncio.StreamReader, writer: Writer) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()
