"""The gateway's server: HTTP and WebSockets on the sockets that systemd has opened.

access.py decides about every connection before a route gets it. The library supports only GET
requests and one request for each connection, which is sufficient here.
"""

import asyncio
import logging
import os
import socket
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as RawRequest
from websockets.http11 import Response

from dora_systemd.decisions.gateway.access import (
    STRANGER_SECONDS,
    Door,
    has_token,
    refuse_address,
    refuse_user,
)
from dora_systemd.decisions.gateway.request import Answer, Request, text_answer
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.live.acting import ACTIONS
from dora_systemd.gateway.routes import GET, OPEN_TO_ALL, SOCKETS
from dora_systemd.scope import Scope
from dora_systemd.trust.socket_table import peer_uid

log = logging.getLogger(__name__)

MAX_FRAME = 1024 * 1024
"""Maximum bytes of a frame; the limit of dora's own coordinator."""

OPEN_SECONDS = 20.0
"""Timeout for a request to arrive completely and be answered."""
_ANSWER_SECONDS = 15.0
_BACKLOG = 1024
_REASON_BYTES = 120
"""Just below what a closing frame can have."""

_THREADS = 64
"""Blocking calls at the same time, such as stops of dataflows with a long grace duration. asyncio
itself allows a few more than the machine has processors: one page could hold up all others."""

_ALWAYS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}

_quiet = logging.getLogger("dora_systemd.websockets")
# Malformed requests are not our errors, and the library logs a traceback for each of them.
_quiet.setLevel(logging.CRITICAL + 1)


class Gateway:
    """Serves one scope. token: required from callers that are other users."""

    def __init__(self, scope: Scope, token: str) -> None:
        self._scope = scope
        self._token = token
        self._count = 0
        self._door = Door(os.getuid())
        self._since = time.monotonic()

    async def run(self, sockets: Sequence[socket.socket], idle_seconds: float) -> None:
        """Serve until there was no connection for `idle_seconds`; cancel it to end at once."""
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS))
        while not await self._round(sockets, idle_seconds):
            log.debug("a connection came at the last moment")

    async def _round(self, sockets: Sequence[socket.socket], idle_seconds: float) -> bool:
        """Listen until idle, then close; whether no connection came in between."""
        servers = [await self._listen(one) for one in sockets]
        try:
            while (left := self._idle_left(idle_seconds)) > 0:
                await asyncio.sleep(left)
        finally:
            # systemd keeps the sockets: later connections start the next gateway.
            for server in servers:
                server.close(close_connections=False)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        return self._count == 0

    def _idle_left(self, idle_seconds: float) -> float:
        if self._count or ACTIONS.is_acting:
            return idle_seconds
        return self._since + idle_seconds - time.monotonic()

    async def _listen(self, listener: socket.socket) -> Server:
        return await serve(
            self._talk,
            sock=listener.dup(),
            process_request=self._answer,
            create_connection=self._connection_class(),
            backlog=_BACKLOG,
            server_header="dora-systemd",
            logger=_quiet,
            compression=None,
            max_size=MAX_FRAME,
            open_timeout=OPEN_SECONDS,
            # A dora command that waits for a reply does not read, so it answers no ping.
            ping_interval=None,
        )

    def _connection_class(self) -> type[ServerConnection]:
        gateway = self

        class Counted(ServerConnection):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                gateway._count += 1
                ends = map(transport.get_extra_info, ("peername", "sockname"))
                self._uid = _uid_behind(*ends)
                self._is_in = gateway._door.enter(self._uid)
                super().connection_made(transport)
                if not self._is_in:
                    self.transport.abort()
                elif gateway._door.is_stranger(self._uid):
                    self.loop.call_later(STRANGER_SECONDS, self._end_if_silent)

            def connection_lost(self, exc: Exception | None) -> None:
                if self._is_in:
                    gateway._door.leave(self._uid)
                gateway._count -= 1
                gateway._since = time.monotonic()
                super().connection_lost(exc)

            def _end_if_silent(self) -> None:
                if self.request is None:
                    self.transport.abort()

        return Counted

    async def _answer(self, connection: ServerConnection, raw: RawRequest) -> Response | None:
        """The response to an HTTP request; None lets a WebSocket connection begin."""
        try:
            answer = self._refusal(connection, raw) or await self._routed(raw)
        except TimeoutError:
            answer = text_answer(504, "no answer in time")
        except DoraSystemdError as error:
            answer = text_answer(503, f"{error.message}\n{error.hint}".strip())
        except Exception as error:
            log.error("cannot answer %.200s: %s: %s", raw.path, type(error).__name__, error)
            answer = text_answer(500, "internal error in the gateway, see its journal")
        return None if answer is None else _response(answer)

    def _refusal(self, connection: ServerConnection, raw: RawRequest) -> Answer | None:
        values = raw.headers.get_all
        refusal = refuse_address(values("Host"), values("Origin"))
        is_open = _path(raw) in OPEN_TO_ALL
        if refusal or is_open or has_token(values("Authorization"), self._token):
            return refusal
        # Look up the user again; an address is None once the client has disconnected.
        uid = _uid_behind(connection.remote_address, connection.local_address)
        return refuse_user(uid, os.getuid())

    async def _routed(self, raw: RawRequest) -> Answer | None:
        # get() raises for a header that occurs twice.
        upgrade = ",".join(raw.headers.get_all("Upgrade")).lower()
        path, wants_socket = _path(raw), "websocket" in upgrade
        if getattr(raw, "method", "GET") != "GET":
            return text_answer(405, "the gateway takes GET only", Allow="GET")
        if path in SOCKETS:
            return None if wants_socket else text_answer(426, "a WebSocket", Upgrade="websocket")
        if path not in GET or wants_socket:
            return text_answer(404, "there is nothing here")
        async with asyncio.timeout(_ANSWER_SECONDS):
            return await GET[path](Request(path, self._scope))

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one WebSocket connection."""
        raw = connection.request
        assert raw is not None
        path = _path(raw)
        try:
            await SOCKETS[path](connection, Request(path, self._scope))
        except ConnectionClosed:
            return
        except DoraSystemdError as error:
            reason = error.message.encode()[:_REASON_BYTES].decode(errors="ignore")
            await connection.close(1011, reason)
        except Exception as error:
            log.error("cannot continue with %.200s: %s: %s", raw.path, type(error).__name__, error)
            await connection.close(1011, "internal error in the gateway, see its journal")


def _uid_behind(peer: Any, own: Any) -> int | None:
    """The user at the other end; an address is None once the client has disconnected."""
    return peer_uid(peer[:2], own[:2]) if peer and own else None


def _path(raw: RawRequest) -> str:
    return raw.path.partition("?")[0]


def _response(answer: Answer) -> Response:
    status = HTTPStatus(answer.status)
    fields: dict[str, Any] = {
        "Connection": "close",
        "Content-Length": str(len(answer.body)),
        "Content-Type": answer.content_type,
        **_ALWAYS,
        **answer.headers,
    }
    return Response(status.value, status.phrase, Headers(fields), answer.body)
