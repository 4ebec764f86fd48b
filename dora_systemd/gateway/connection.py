"""One connection of the gateway: an HTTP request, and what follows it.

Uses the protocol layer of websockets over asyncio's streams, as the client of dora's coordinators
does: that layer is equal in all versions of websockets that distributions have.
"""

import asyncio
from collections.abc import AsyncIterable, Callable
from contextlib import suppress
from email.utils import formatdate
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from websockets.datastructures import Headers
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response

from dora_systemd.adapters.dora.websocket import CHUNK, IS_OLD, State, Stream
from dora_systemd.decisions.gateway.request import Answer, text_answer

if TYPE_CHECKING or not IS_OLD:
    from websockets.server import ServerProtocol
else:
    from websockets.server import ServerConnection as ServerProtocol

MAX_FRAME = 1024 * 1024
"""Maximum bytes of a message; the limit of dora's own coordinator."""

_CLOSE_SECONDS = 10.0
"""Timeout for the other end to close, too."""
_PART_SECONDS = 60.0
"""Timeout for a part of a file to be taken."""
_NO_REQUEST = "no valid request: the gateway takes GET by HTTP/1.1 only"
_NAME = {"Server": "dora-systemd"}


class Gone(ConnectionError):
    """The other end has disconnected."""


class ServerSocket(Stream):
    """A connection that a client has opened."""

    _protocol: ServerProtocol

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(ServerProtocol(max_size=MAX_FRAME), reader, writer)
        self._turn = asyncio.Lock()

    @property
    def ends(self) -> tuple[Any, Any]:
        """The addresses of the other end and of this one; None once it has disconnected."""
        peer, own = map(self._writer.get_extra_info, ("peername", "sockname"))
        return peer, own

    def end_if_silent(self) -> None:
        """Close at once if no request has arrived."""
        if self._opening is None:
            self.abort()

    async def request(self) -> Request | None:
        """The request; None, and a refusal sent, if it is not valid HTTP. Raises OSError."""
        try:
            while self._opening is None:
                if (error := self._protocol.handshake_exc) is not None:
                    raise ConnectionError from error
                await self._receive()
        except ConnectionError:
            # Later versions of websockets answer some of them, such as one that is too long.
            if not self._has_written:
                await self.answer(text_answer(HTTPStatus.BAD_REQUEST, _NO_REQUEST))
            return None
        assert isinstance(self._opening, Request)
        return self._opening

    async def begin(self, request: Request) -> bool:
        """Let a WebSocket connection begin; whether it has. Raises OSError."""
        response = self._protocol.accept(request)
        if response.status_code != HTTPStatus.SWITCHING_PROTOCOLS:
            await self._respond(response)
        elif self._protocol.state is State.CONNECTING:
            response.headers.update(_NAME)
            self._protocol.send_response(response)
            await self._push()
        return self._protocol.state is State.OPEN

    async def answer(self, answer: Answer) -> None:
        """Send an HTTP response, which ends the connection after its rest. Raises OSError."""
        status = HTTPStatus(answer.status)
        fields: dict[str, Any] = {
            "Date": formatdate(usegmt=True),
            "Connection": "close",
            "Content-Length": str(len(answer.body) + answer.rest_size),
            "Content-Type": answer.content_type,
            **answer.headers,
        }
        response = Response(status.value, status.phrase, Headers(fields), answer.body)
        await self._respond(response, is_whole=answer.rest is None)

    async def send_rest(self, read: Callable[[], bytes]) -> None:
        """Send what follows the body of an HTTP response. Raises OSError, TimeoutError."""
        while part := await asyncio.to_thread(read):
            self._writer.write(part)
            async with asyncio.timeout(_PART_SECONDS):
                await self._writer.drain()
        self._writer.write_eof()

    async def _respond(self, response: Response, is_whole: bool = True) -> None:
        """Past the protocol layer: it has already failed if more bytes follow the request."""
        response.headers.update(_NAME)
        self._writer.write(response.serialize())
        await self._writer.drain()
        if is_whole:
            self._writer.write_eof()

    async def send(self, message: str | bytes | AsyncIterable[str]) -> None:
        try:
            async with self._turn:
                if isinstance(message, str):
                    self._protocol.send_text(message.encode())
                elif isinstance(message, bytes):
                    self._protocol.send_binary(message)
                else:
                    await self._send_parts(message)
                await self._push()
        except (OSError, WebSocketException) as error:
            raise Gone from error

    async def _send_parts(self, parts: AsyncIterable[str]) -> None:
        send: Callable[..., None] = self._protocol.send_text
        async for part in parts:
            send(part.encode(), fin=False)
            send = self._protocol.send_continuation
            await self._push()
        send(b"", fin=True)

    async def close(self, code: int = 1000, reason: str = "") -> None:
        """Send a closing frame; who reads sees the end, at the latest after _CLOSE_SECONDS."""
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code, reason)
            self._flush()
            asyncio.get_running_loop().call_later(_CLOSE_SECONDS, self.abort)

    async def end(self) -> None:
        """Wait until the other end has closed, too, and read what it still sends."""
        is_answered = self._protocol.state is State.CONNECTING
        with suppress(OSError, TimeoutError, WebSocketException):
            async with asyncio.timeout(_CLOSE_SECONDS):
                while not self._reader.at_eof():
                    if self._is_over:
                        self._writer.write_eof()
                    await (self._reader.read(CHUNK) if is_answered else self._receive())
        self.abort()

    def __aiter__(self) -> "ServerSocket":
        """The messages, until either end closes."""
        return self

    async def __anext__(self) -> str | bytes:
        try:
            return await self.recv()
        except OSError:
            raise StopAsyncIteration from None
