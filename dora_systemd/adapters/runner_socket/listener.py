"""The runner's socket in the RuntimeDirectory; client.py documents who can access the socket.

A relay request turns the connection into one to the coordinator, whatever network the cell has.
"""

import asyncio
import contextlib
import json
import socket
import sys
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from dora_systemd.adapters.runner_socket.client import MAX_BYTES, Request, error_reply, parse_line
from dora_systemd.adapters.runner_socket.door import Door, listen
from dora_systemd.decisions.dora.protocol import Coordinator
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error, words_of

_CHUNK = 1 << 16
# From Python 3.13 on, asyncio stats the address of a listener to remove the file at the end. Ours
# is below a descriptor that is closed: the number can have become that of any other file.
_OPTIONS: dict[str, Any] = {"cleanup_socket": False} if sys.version_info >= (3, 13) else {}


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


Answer = Callable[[Request], Awaitable[dict[str, Any]]]
Session = Callable[[Request, Ends], Coroutine[Any, Any, None]]
"""Serves one connection after the request that has begun the session, until either side ends."""
Reach = Callable[[], Coordinator]
"""The address of the coordinator. Raises DoraSystemdError (NOT_RUNNING) if it does not listen yet.
"""


MAX_SESSION_LINE = 1 << 18


async def serve(
    path: Path,
    answer: Answer,
    reach: Reach,
    sessions: Mapping[str, Session] | None = None,
    door: Door | None = None,
) -> None:
    """Answer requests at `path` forever. An error is {"error": ..., "hint": ..., "code": ...}.

    sessions: by the verb that begins one. door: listens at `path` already.
    """
    limit = MAX_SESSION_LINE if sessions else MAX_BYTES

    async def talk(reader: asyncio.StreamReader, writer: Writer) -> None:
        with contextlib.suppress(OSError, ValueError):
            request = parse_line(await reader.readline())
            verb = str(request.get("verb")) if request else ""
            if sessions and request and verb in sessions:
                await sessions[verb](request, Ends(reader, writer))
            elif verb == "relay":
                await _relay(Ends(reader, writer), reach)
            else:
                await _send(writer, await _answer(request, answer, reach))
        writer.close()

    listener, kept = door.hand_over() if door else (listen(path), [])
    with listener:
        server = await asyncio.start_unix_server(talk, sock=listener, limit=limit, **_OPTIONS)
        begun = [await taken_over(*one, limit) for one in kept]
        talks = [asyncio.create_task(talk(*ends)) for ends in begun]
        async with server:
            try:
                await server.serve_forever()
            finally:
                for one in talks:
                    one.cancel()


async def _answer(request: Request | None, answer: Answer, reach: Reach) -> dict[str, Any]:
    if request is None:
        return error_reply(usage_error("cannot read the request"))
    try:
        if request.get("verb") == "coordinator":
            return reach().raw()
        return await answer(request)
    except DoraSystemdError as error:
        return error_reply(error)
    except Exception as error:
        # A malformed request only ends its own connection.
        what = f"cannot do that: {type(error).__name__}: {error}"
        return error_reply(DoraSystemdError(what, "please report it"))


async def _relay(caller: Ends, reach: Reach) -> None:
    try:
        coordinator = reach()
        there = Ends(*await asyncio.open_connection("127.0.0.1", coordinator.port))
    except (DoraSystemdError, OSError) as error:
        hint = "it may be starting or stopping; see doractl list"
        message = "cannot reach the dora coordinator"
        own = error if isinstance(error, DoraSystemdError) else None
        lost = own or DoraSystemdError(f"{message}: {words_of(error)}", hint, ExitCode.NOT_RUNNING)
        await _send(caller.writer, error_reply(lost))
        return
    await _send(caller.writer, {"token": coordinator.token})
    await splice(caller, there)


async def refuse(caller: Ends, error: DoraSystemdError) -> None:
    """Answer with an error, instead of a session."""
    await _send(caller.writer, error_reply(error))


async def _send(writer: Writer, reply: Mapping[str, Any]) -> None:
    writer.write(json.dumps(reply).encode() + b"\n")
    await writer.drain()
