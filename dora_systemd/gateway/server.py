"""The gateway's server: HTTP and WebSockets on the sockets that systemd has opened.

decisions/gateway/request.py decides about every connection before a route gets it. There is one
request for each connection.
"""

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.http11 import Request as RawRequest

from dora_systemd.decisions.gateway.request import (
    STRANGER_SECONDS,
    Answer,
    Door,
    Request,
    has_token,
    refuse_address,
    refuse_user,
    text_answer,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.connection import Gone, ServerSocket
from dora_systemd.gateway.live.actions import ACTIONS
from dora_systemd.gateway.routes import OPEN_TO_ALL, SOCKETS, find_route
from dora_systemd.scope import Scope
from dora_systemd.trust.sockets import peer_uid

log = logging.getLogger(__name__)

OPEN_SECONDS = 20.0
"""Timeout for a request to arrive completely and be answered."""
_ANSWER_SECONDS = 15.0
_BACKLOG = 1024
_REASON_BYTES = 120
"""Just below what a closing frame can have."""

_THREADS = 64
"""Blocking calls in parallel, such as stops of dataflows with a long grace duration. The default of
asyncio is a few more than the machine has processors: one page could block all others."""

_ALWAYS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}

# Malformed requests are not our errors, and the library logs a traceback for each of them.
for _name in ("websockets.client", "websockets.server"):
    logging.getLogger(_name).setLevel(logging.CRITICAL + 1)


class Gateway:
    """Serves one scope. token: required from callers that are other users."""

    def __init__(self, scope: Scope, token: str) -> None:
        self._scope = scope
        self._token = token
        self._count = 0
        self._door = Door(os.getuid())
        self._since = time.monotonic()
        self._tasks: set[asyncio.Task[None]] = set()

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
                server.close()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        return self._count == 0

    def _idle_left(self, idle_seconds: float) -> float:
        if self._count or ACTIONS.is_acting:
            return idle_seconds
        return self._since + idle_seconds - time.monotonic()

    async def _listen(self, listener: socket.socket) -> asyncio.Server:
        return await asyncio.start_server(self._enter, sock=listener.dup(), backlog=_BACKLOG)

    def _enter(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take a connection: asyncio calls this before anything is read from it."""
        socket = ServerSocket(reader, writer)
        uid = _uid_behind(*socket.ends)
        if not self._door.enter(uid):
            socket.abort()
            return
        self._count += 1
        task = asyncio.get_running_loop().create_task(self._serve(socket, uid))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, socket: ServerSocket, uid: int | None) -> None:
        if self._door.is_stranger(uid):
            asyncio.get_running_loop().call_later(STRANGER_SECONDS, socket.end_if_silent)
        try:
            with suppress(OSError, TimeoutError, WebSocketException):
                async with asyncio.timeout(OPEN_SECONDS):
                    request, rest = await self._open(socket)
                if request is not None:
                    await self._talk(socket, request)
                if rest is not None:
                    await socket.send_rest(rest)
                await socket.end()
        except Exception as error:
            log.error("cannot serve a connection: %s: %s", type(error).__name__, error)
        finally:
            socket.abort()
            self._door.leave(uid)
            self._count -= 1
            self._since = time.monotonic()

    async def _open(
        self, socket: ServerSocket
    ) -> tuple[RawRequest | None, Callable[[], bytes] | None]:
        """Answer the request; the request itself if a WebSocket connection has begun.

        The second one reads the rest of the answer, which may take longer.
        """
        raw = await socket.request()
        if raw is None:
            return None, None
        answer = await self._answer(socket, raw)
        if answer is None:
            return raw if await socket.begin(raw) else None, None
        await socket.answer(replace(answer, headers={**_ALWAYS, **answer.headers}))
        return None, answer.rest

    async def _answer(self, socket: ServerSocket, raw: RawRequest) -> Answer | None:
        """The answer to an HTTP request; None lets a WebSocket connection begin."""
        try:
            return self._refusal(socket, raw) or await self._routed(raw)
        except TimeoutError:
            return text_answer(504, "no answer in time")
        except DoraSystemdError as error:
            return text_answer(503, f"{error.message}\n{error.hint}".strip())
        except Exception as error:
            log.error("cannot answer %.200s: %s: %s", raw.path, type(error).__name__, error)
            return text_answer(500, "internal error in the gateway, see its journal")

    def _refusal(self, socket: ServerSocket, raw: RawRequest) -> Answer | None:
        values = raw.headers.get_all
        refusal = refuse_address(values("Host"), values("Origin"))
        is_open = _path(raw) in OPEN_TO_ALL
        if refusal or is_open or has_token(values("Authorization"), self._token):
            return refusal
        # Look up the user again; an address is None once the client has disconnected.
        return refuse_user(_uid_behind(*socket.ends), os.getuid())

    async def _routed(self, raw: RawRequest) -> Answer | None:
        # get() raises for a header that occurs twice.
        upgrade = ",".join(raw.headers.get_all("Upgrade")).lower()
        path, wants_socket = _path(raw), "websocket" in upgrade
        if getattr(raw, "method", "GET") != "GET":
            return text_answer(405, "the gateway takes GET only", Allow="GET")
        if path in SOCKETS:
            return None if wants_socket else text_answer(426, "a WebSocket", Upgrade="websocket")
        route = find_route(path)
        if route is None or wants_socket:
            return text_answer(404, "there is nothing here")
        async with asyncio.timeout(_ANSWER_SECONDS):
            return await route(Request(path, self._scope))

    async def _talk(self, socket: ServerSocket, raw: RawRequest) -> None:
        path = _path(raw)
        try:
            await SOCKETS[path](socket, Request(path, self._scope))
            await socket.close()
        except Gone:
            return
        except DoraSystemdError as error:
            reason = error.message.encode()[:_REASON_BYTES].decode(errors="ignore")
            await socket.close(1011, reason)
        except Exception as error:
            log.error("cannot continue with %.200s: %s: %s", raw.path, type(error).__name__, error)
            await socket.close(1011, "internal error in the gateway, see its journal")


def _uid_behind(peer: Any, own: Any) -> int | None:
    """The user at the other end; an address is None once the client has disconnected."""
    return peer_uid(peer[:2], own[:2]) if peer and own else None


def _path(raw: RawRequest) -> str:
    return raw.path.partition("?")[0]
