"""One WebSocket connection to the coordinator of a cell."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.protocol import LogRecord, Params, Reply, encode_request, parse_frame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dora_systemd.websocket import WebSocket

_OPTIONS: dict[str, Any] = {
    # A coordinator answers no ping while a request is pending; frames are as large as a descriptor;
    # and a proxy has no business between two processes of one machine.
    "ping_interval": None,
    "compression": None,
    "max_size": None,
    "proxy": None,
}
REQUEST_SECONDS = 35.0
"""Just above the 30 s after which the coordinator itself gives up on its daemon."""


def _url(port: int) -> str:
    return f"ws://127.0.0.1:{port}/api/control"


def _headers(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


class Connection:
    """A connection for requests, answered one after the other, or for the events of one run."""

    def __init__(self, socket: "WebSocket") -> None:
        self._socket = socket

    @classmethod
    async def open(cls, port: int, token: str) -> "Connection":
        """Connect. Raises DoraSystemdError."""
        from dora_systemd.websocket import WebSocket, WebSocketException

        try:
            return cls(await WebSocket.connect(_url(port), _headers(token)))
        except (OSError, WebSocketException) as error:
            raise _unreachable(port, error) from error

    async def request(self, params: Params, seconds: float = REQUEST_SECONDS) -> Reply:
        """Send a request and wait for its reply. Raises DoraSystemdError, also after `seconds`."""
        from dora_systemd.websocket import WebSocketException

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

    async def read_events(self, on_record: Callable[[LogRecord], None]) -> None:
        """Give every event to on_record, until the connection is closed by either side."""
        async for text in self.frames():
            if isinstance(frame := parse_frame(text), LogRecord):
                on_record(frame)

    async def frames(self) -> AsyncIterator[str | bytes]:
        """Every message as it comes, until the connection is closed by either side."""
        with suppress(OSError):
            while True:
                yield await self._socket.recv()

    async def close(self) -> None:
        """Close at once: the peer may be dead or hang."""
        self.abort()

    def abort(self) -> None:
        """The same for who cannot wait."""
        self._socket.abort()


def request(control: Path, params: Params, seconds: float = REQUEST_SECONDS) -> Reply:
    """One request to the cell whose control.json is at `control`, without asyncio.

    Raises DoraSystemdError: NO_PERMISSION or NOT_RUNNING when there is no way in.
    """
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    port, token = read_access(control)
    ident, text = encode_request(params)
    try:
        with connect(_url(port), additional_headers=_headers(token), **_OPTIONS) as socket:
            socket.send(text)
            while True:
                frame = parse_frame(socket.recv(timeout=seconds))
                if isinstance(frame, Reply) and frame.id == ident:
                    return frame
    except TimeoutError as error:
        raise _silent(params, error) from error
    except (OSError, WebSocketException) as error:
        raise _unreachable(port, error) from error


def read_access(control: Path) -> tuple[int, str]:
    """Port and token in a control.json.

    Raises DoraSystemdError: NO_PERMISSION for another user's cell, NOT_RUNNING when there is none.
    """
    with _reading(control):
        access = json.loads(control.read_text())
        return int(access["port"]), str(access["token"])


@contextmanager
def _reading(control: Path) -> "Iterator[None]":
    what = f"cannot reach the dora coordinator of {control.parent.name}"
    try:
        yield
    except PermissionError as error:
        hint = "only root and the user whom it runs as may"
        raise DoraSystemdError(what, hint, ExitCode.NO_PERMISSION) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        hint = f"it is not running: see `doractl status {control.parent.name}`"
        raise DoraSystemdError(what, hint, ExitCode.NOT_RUNNING) from error


def _unreachable(port: int, error: Exception) -> DoraSystemdError:
    hint = (
        "see `doractl list`; a dataflow that starts or stops has no coordinator for a moment, "
        "and one with a private network none that can be reached from here"
    )
    return DoraSystemdError(
        f"cannot reach the dora coordinator on port {port}: {error or type(error).__name__}", hint
    )


def _silent(params: Params, error: Exception) -> DoraSystemdError:
    name = params if isinstance(params, str) else next(iter(params))
    how = "no reply in time" if isinstance(error, TimeoutError) else "it closed the connection"
    return DoraSystemdError(f"cannot get an answer from dora to {name}: {how}")
