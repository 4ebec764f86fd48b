"""A WebSocket client over asyncio's streams, for loopback, on the protocol layer of websockets.

The asyncio client of websockets imports OpenSSL and proxy support, a fifth of the memory of a
runner. This module uses the layer below, which does no I/O:
https://websockets.readthedocs.io/en/stable/howto/sansio.html

That layer is also what websockets 10 (Debian 12, Ubuntu 24.04) and later versions have in common,
by other names.
"""

import asyncio
import socket as sockets
import sys
from collections import deque
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING

from websockets.exceptions import WebSocketException
from websockets.frames import Frame, Opcode
from websockets.uri import parse_uri
from websockets.version import version

IS_OLD = version.startswith("10.")

if TYPE_CHECKING or not IS_OLD:
    from websockets.client import ClientProtocol
    from websockets.protocol import Protocol, State
else:
    # Its client and server also import those of earlier versions, and OpenSSL with them.
    for _name in ("legacy", "legacy.client", "legacy.server"):
        sys.modules.setdefault(f"websockets.{_name}", ModuleType(_name))
    from websockets.client import ClientConnection as ClientProtocol
    from websockets.connection import Connection as Protocol
    from websockets.connection import State

OPEN_SECONDS = 35.0
"""Timeout of a connection: a coordinator that waits for its daemon accepts none for 30 s."""
CHUNK = 1 << 16


class Stream:
    """Messages over one connection, for the client as for the server."""

    def __init__(
        self, protocol: Protocol, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._protocol = protocol
        self._reader = reader
        self._writer = writer
        self._parts: list[Frame] = []
        self._messages: deque[str | bytes] = deque()
        self._opening: object = None
        """The first thing that was received: a response, or a request."""
        self._is_over = False
        self._has_written = False

    async def recv(self) -> str | bytes:
        """The next message. Raises OSError; ConnectionError if either side has closed."""
        while not self._messages:
            if self._protocol.state is not State.OPEN:
                raise ConnectionError("it closed the connection")
            await self._receive()
        return self._messages.popleft()

    def abort(self) -> None:
        """Close at once, because the peer may be dead or hang."""
        self._writer.transport.abort()

    async def _receive(self) -> None:
        self._feed(await self._reader.read(CHUNK))
        self._flush()  # replies of the protocol layer itself, such as a pong
        if self._writer.transport.get_write_buffer_size():
            await self._writer.drain()  # a peer that reads none of them gets no more of them
        for event in self._protocol.events_received():
            if isinstance(event, Frame):
                self._take(event)
            else:
                self._opening = event

    def _feed(self, data: bytes) -> None:
        try:
            if data:
                self._protocol.receive_data(data)
            else:
                self._protocol.receive_eof()
        except (ValueError, EOFError, WebSocketException) as error:
            # websockets 10 raises what later versions keep in handshake_exc.
            raise ConnectionError(f"no valid HTTP: {error}") from error

    def _take(self, frame: Frame) -> None:
        if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
            return
        self._parts.append(frame)
        if frame.fin:
            data = b"".join(part.data for part in self._parts)
            is_text = self._parts[0].opcode is Opcode.TEXT
            self._messages.append(data.decode(errors="replace") if is_text else data)
            self._parts.clear()

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._writer.write(data)
                self._has_written = True
            self._is_over |= not data  # the protocol layer sends nothing more

    async def _push(self) -> None:
        self._flush()
        await self._writer.drain()


class WebSocket(Stream):
    """One connection to a server.

    There is no limit on frames of this cell, which may be as large as descriptors.
    """

    _protocol: ClientProtocol

    @classmethod
    async def connect(
        cls,
        url: str,
        headers: Mapping[str, str],
        stream: sockets.socket | None = None,
        max_size: int | None = None,
    ) -> "WebSocket":
        """Connect to a ws:// URL. Raises OSError, also for a timeout, and WebSocketException.

        stream: an existing connection. max_size: maximum bytes of a message.
        """
        uri = parse_uri(url)
        async with asyncio.timeout(OPEN_SECONDS):
            if stream is None:
                reader, writer = await asyncio.open_connection(uri.host, uri.port)
            else:
                reader, writer = await asyncio.open_connection(sock=stream)
            socket = cls(ClientProtocol(uri, max_size=max_size), reader, writer)
            try:
                await socket._shake_hands(headers)
            except BaseException:
                socket.abort()
                raise
        return socket

    async def _shake_hands(self, headers: Mapping[str, str]) -> None:
        request = self._protocol.connect()
        request.headers.update(headers)
        self._protocol.send_request(request)
        self._flush()
        while self._protocol.state is State.CONNECTING:
            if self._protocol.handshake_exc is not None:
                raise self._protocol.handshake_exc
            await self._receive()

    async def send(self, text: str) -> None:
        """Send a message. Raises OSError, and WebSocketException if the connection is closed."""
        self._protocol.send_text(text.encode())
        await self._push()


__all__ = ["IS_OLD", "State", "Stream", "WebSocket", "WebSocketException"]
