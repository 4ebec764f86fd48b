"""The client against the server of the library, on loopback."""

import asyncio
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import cast

import pytest
from websockets.asyncio.server import ServerConnection, serve
from websockets.client import ClientProtocol
from websockets.http11 import Request, Response
from websockets.protocol import Protocol, Side

from dora_systemd.adapters.dora.websocket import WebSocket, WebSocketException

Handler = Callable[[ServerConnection], Awaitable[None]]
TOKEN = {"Authorization": "Bearer token"}


def url(port: int) -> str:
    return f"ws://127.0.0.1:{port}/any"


async def refuse_others(socket: ServerConnection, request: Request) -> Response | None:
    if request.headers.get("Authorization") == TOKEN["Authorization"]:
        return None
    return socket.respond(HTTPStatus.UNAUTHORIZED, "no token")


def talk(handler: Handler, use: Callable[[WebSocket], Awaitable[object]]) -> object:
    """What `use` returns, of a connection that `handler` serves."""

    async def both() -> object:
        async with serve(
            handler, "127.0.0.1", 0, process_request=refuse_others, max_size=None
        ) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            socket = await WebSocket.connect(url(port), TOKEN)
            try:
                return await use(socket)
            finally:
                socket.abort()

    return asyncio.run(both())


async def echo(socket: ServerConnection) -> None:
    async for message in socket:
        await socket.send(message)


@pytest.mark.parametrize("text", ["", "ä\n", "x" * 3_000_000])
def test_messages_come_back(text: str) -> None:
    async def use(socket: WebSocket) -> list[str | bytes]:
        await socket.send(text)
        await socket.send("next")
        return [await socket.recv(), await socket.recv()]

    assert talk(echo, use) == [text, "next"]


def test_parts_pings_and_bytes() -> None:
    async def handler(socket: ServerConnection) -> None:
        await socket.send(["a", "b", "c"])
        await (await socket.ping())  # answered while the client waits for more
        await socket.send(b"\0\xff")

    async def use(socket: WebSocket) -> list[str | bytes]:
        return [await socket.recv(), await socket.recv()]

    assert talk(handler, use) == ["abc", b"\0\xff"]


def test_the_end() -> None:
    async def handler(socket: ServerConnection) -> None:
        await socket.send("last")

    async def use(socket: WebSocket) -> None:
        assert await socket.recv() == "last"
        with pytest.raises(ConnectionError):
            await socket.recv()
        with pytest.raises(WebSocketException):
            await socket.send("too late")

    talk(handler, use)


def test_lost_in_the_middle() -> None:
    async def handler(socket: ServerConnection) -> None:
        socket.transport.abort()

    async def use(socket: WebSocket) -> None:
        with pytest.raises(OSError):
            await socket.recv()

    talk(handler, use)


def test_refused() -> None:
    async def both() -> None:
        async with serve(echo, "127.0.0.1", 0, process_request=refuse_others) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            with pytest.raises(WebSocketException, match="401"):
                await WebSocket.connect(url(port), {})

    asyncio.run(both())


def test_nobody_there_and_no_websocket() -> None:
    async def hang_up(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()

    async def both() -> None:
        server = await asyncio.start_server(hang_up, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        with pytest.raises((OSError, WebSocketException)):
            await WebSocket.connect(url(port), TOKEN)
        server.close()
        await server.wait_closed()
        with pytest.raises(OSError):
            await WebSocket.connect(url(port), TOKEN)

    asyncio.run(both())


def test_what_is_no_utf_8_is_shown_as_far_as_possible() -> None:
    async def handler(socket: ServerConnection) -> None:
        async with socket.send_context():
            socket.protocol.send_text(b"a\xff")
        await socket.wait_closed()

    async def use(socket: WebSocket) -> str | bytes:
        return await socket.recv()

    assert talk(handler, use) == "a\ufffd"


class Deaf:
    """A writer, and its transport, whose peer reads nothing."""

    def __init__(self) -> None:
        self.size = self.drained = 0

    @property
    def transport(self) -> "Deaf":
        return self

    def get_write_buffer_size(self) -> int:
        return self.size

    def write(self, data: bytes) -> None:
        self.size += len(data)

    async def drain(self) -> None:
        self.drained += 1
        if self.size > 1000:
            raise ConnectionResetError("it would wait")


def test_a_peer_that_sends_pings_and_reads_nothing_has_to_wait() -> None:
    """Else what it does not read would take all memory of root's gateway."""

    async def work() -> None:
        reader, writer = asyncio.StreamReader(), Deaf()
        protocol = cast(ClientProtocol, Protocol(Side.CLIENT))
        for _ in range(50):
            reader.feed_data(b"\x89\x7d" + b"x" * 125)  # a ping with 125 bytes
        socket = WebSocket(protocol, reader, cast(asyncio.StreamWriter, writer))
        with pytest.raises(ConnectionResetError, match="it would wait"):
            async with asyncio.timeout(30):
                await socket.recv()
        assert writer.drained == 1

    asyncio.run(work())
