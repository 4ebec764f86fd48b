"""One WebSocket connection to the coordinator of a cell."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.decisions.dora.protocol import (
    Coordinator,
    LogRecord,
    Params,
    Reply,
    encode_request,
    ends_subscription,
    parse_coordinator,
    parse_frame,
)
from dora_systemd.errors import DoraSystemdError, ExitCode, words_of
from dora_systemd.trust.sockets import plain

if TYPE_CHECKING:
    import socket as sockets

    from dora_systemd.adapters.dora.websocket import WebSocket

MAX_BYTES = 64 * 1024 * 1024
"""Maximum bytes of a message over a relay, where the peer may be hostile."""

OPEN_SECONDS = 4.0
"""Timeout of the handshake over a relay."""
REQUEST_SECONDS = 35.0
"""Just above the 30 s after which the coordinator gives up on its daemon."""

_URL = "ws://127.0.0.1:{}/api/control"


def _headers(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


class Connection:
    """A connection for requests, which are answered in turn, or for the events of one run."""

    def __init__(self, socket: "WebSocket") -> None:
        self._socket = socket

    @classmethod
    async def open(cls, port: int, token: str) -> "Connection":
        """Connect. Raises DoraSystemdError."""
        from dora_systemd.adapters.dora.websocket import WebSocket, WebSocketException

        try:
            return cls(await WebSocket.connect(_URL.format(port), _headers(token)))
        except (OSError, WebSocketException) as error:
            raise _unreachable(f" on port {port}", error) from error

    @classmethod
    async def over(cls, stream: "sockets.socket", token: str) -> "Connection":
        """Connect through a relay of a cell's runner. Raises DoraSystemdError."""
        from dora_systemd.adapters.dora.websocket import WebSocket, WebSocketException

        try:
            return cls(await WebSocket.connect(_URL.format(80), _headers(token), stream, MAX_BYTES))
        except (OSError, WebSocketException) as error:
            stream.close()
            raise _unreachable("", error) from error

    async def request(self, params: Params, seconds: float = REQUEST_SECONDS) -> Reply:
        """Send a request and wait for its reply. Raises DoraSystemdError, also after `seconds`."""
        from dora_systemd.adapters.dora.websocket import WebSocketException

        ident, text = encode_request(params)
        try:
            async with asyncio.timeout(seconds):
                await self._socket.send(text)
                while True:
                    frame = parse_frame(await self._socket.recv())
                    if isinstance(frame, Reply) and frame.id == ident:
                        return frame
        except (OSError, WebSocketException) as error:
            raise _silent(params, error) from error

    async def read_events(self, on_record: Callable[[LogRecord], None]) -> bool:
        """Pass every event to on_record until either side closes the connection.

        Return True if only the subscription has ended, and not the run.
        """
        async for text in self.frames():
            if isinstance(frame := parse_frame(text), LogRecord):
                on_record(frame)
                if ends_subscription(frame):
                    return True
        return False

    async def frames(self) -> AsyncIterator[str | bytes]:
        """Every message, until either side closes the connection."""
        with suppress(OSError):
            while True:
                yield await self._socket.recv()

    def close(self) -> None:
        """Close at once, because the peer may be dead or hang."""
        self._socket.abort()


def request(
    stream: "sockets.socket",
    token: str,
    params: Params,
    seconds: float = REQUEST_SECONDS,
    open_seconds: float = OPEN_SECONDS,
) -> Reply:
    """Send one request through a relay of a cell's runner, and close.

    Not for a thread with a running loop. The handshake may take `open_seconds`, and the reply
    `seconds`, including other messages before it. Raises DoraSystemdError.
    """

    async def ask() -> Reply:
        try:
            async with asyncio.timeout(open_seconds):
                connection = await Connection.over(stream, token)
        except TimeoutError as error:
            raise _silent(params, error) from error
        with closing(connection):
            return await connection.request(params, seconds)

    with stream:
        return asyncio.run(ask())


def read_coordinator(path: Path) -> Coordinator:
    """The coordinator in the control.json at `path`, which the runner has written.

    Raises DoraSystemdError (NOT_RUNNING) if there is no such file yet.
    """
    try:
        return parse_coordinator(json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        message = f"cannot reach the dora coordinator of {path.parent.name}: it is not running"
        hint = "it may be starting or stopping; see doractl list"
        raise DoraSystemdError(message, hint, ExitCode.NOT_RUNNING) from error


def _unreachable(where: str, error: Exception) -> DoraSystemdError:
    hint = "see `doractl list`; a dataflow that starts or stops has no coordinator for a moment"
    reason = plain(words_of(error))
    return DoraSystemdError(f"cannot reach the dora coordinator{where}: {reason}", hint)


def _silent(params: Params, error: Exception) -> DoraSystemdError:
    name = params if isinstance(params, str) else next(iter(params))
    how = "no reply in time" if isinstance(error, TimeoutError) else "it closed the connection"
    return DoraSystemdError(f"cannot get an answer from dora to {name}: {how}")
