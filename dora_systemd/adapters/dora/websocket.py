"""A WebSocket client over asyncio's streams, for loopback, on the protocol layer of websockets.

The asyncio client of websockets imports OpenSSL and proxy support, a fifth of the memory of a
runner. This module uses the layer below, which does no I/O:
https://websockets.readthedocs.io/en/stable/howto/sansio.html
"""

import asyncio
import socket as sockets
from collections import deque
from collections.abc import Mapping

from websockets.client import ClientProtocol
from websockets.exceptions import WebSocketException
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

OPEN_SECONDS = 35.0
"""As long as for a request: a coordinator that waits for its daemon accepts nothing for 30 s."""
CHUNK = 1 << 16


class WebSocket:
    """One connection.

    There is no limit on frames of the own cell: they may be as large as descriptors.
    """

    def __init__(
        self,
        protocol: ClientProtocol,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self._protocol = protocol
        self._reader = reader
        self._writer = writer
        self._parts: list[Frame] = []
        self._messages: deque[str | bytes] = deque()

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
        self._flush()
        await self._writer.drain()

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
        data = await self._reader.read(CHUNK)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        self._flush()  # replies of the protocol layer itself, such as a pong
        if self._writer.transport.get_write_buffer_size():
            await self._writer.drain()  # a peer that reads none of them gets no more of them
        for event in self._protocol.events_received():
            if isinstance(event, Frame):
                self._take(event)

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


__all__ = ["WebSocket", "WebSocketException"]
