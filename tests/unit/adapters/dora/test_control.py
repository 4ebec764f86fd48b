"""One request through a relay, against the server of the library on a pair of sockets."""

import asyncio
import json
import socket
import threading
from collections.abc import Awaitable, Callable

import pytest
from websockets.asyncio.server import ServerConnection, serve

from dora_systemd.adapters.dora import control
from dora_systemd.decisions.dora.protocol import Reply
from dora_systemd.errors import DoraSystemdError

Handler = Callable[[ServerConnection], Awaitable[None]]


def ask(handler: Handler, seconds: float = 10.0) -> Reply:
    """The reply of a coordinator that `handler` is."""
    ports: list[int] = []
    ready, over = threading.Event(), threading.Event()

    async def coordinator() -> None:
        async with serve(handler, "127.0.0.1", 0) as server:
            ports.append(next(iter(server.sockets)).getsockname()[1])
            ready.set()
            await asyncio.to_thread(over.wait)

    thread = threading.Thread(target=asyncio.run, args=(coordinator(),))
    thread.start()
    try:
        ready.wait()
        stream = socket.create_connection(("127.0.0.1", ports[0]))
        return control.request(stream, "token", "Any", seconds)
    finally:
        over.set()
        thread.join()


async def reply_late(connection: ServerConnection) -> None:
    request = json.loads(await connection.recv())
    await connection.send('{"event": "log", "payload": {}}')
    await connection.send(json.dumps({"id": "another", "result": 1}))
    await connection.send(json.dumps({"id": request["id"], "result": request["params"]}))


async def say_nothing(connection: ServerConnection) -> None:
    await connection.wait_closed()


async def leave(connection: ServerConnection) -> None:
    await connection.recv()
    connection.transport.abort()


def test_the_reply_to_this_request() -> None:
    assert ask(reply_late).result == "Any"


@pytest.mark.parametrize(
    ("handler", "reason"),
    [(say_nothing, "no reply in time"), (leave, "it closed the connection")],
)
def test_no_reply(handler: Handler, reason: str) -> None:
    with pytest.raises(DoraSystemdError, match=f"^cannot get an answer from dora to Any: {reason}"):
        ask(handler, 0.5)


def test_no_handshake() -> None:
    near, far = socket.socketpair()
    with far, pytest.raises(DoraSystemdError, match=r"to Any: no reply in time$"):
        control.request(near, "token", "Any", open_seconds=0.1)
    assert near.fileno() == -1, "the connection is closed"


def test_no_websocket() -> None:
    near, far = socket.socketpair()
    far.sendall(b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\n\r\n")
    with far, pytest.raises(DoraSystemdError, match=r"^cannot reach the dora coordinator: "):
        control.request(near, "token", "Any")
    assert near.fileno() == -1, "the connection is closed"
