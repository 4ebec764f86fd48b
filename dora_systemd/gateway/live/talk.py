"""/api/live: the WebSocket of the status page; page_messages.py defines its messages."""

import asyncio
import json
import socket as sockets
from collections.abc import Coroutine
from contextlib import aclosing, suppress
from typing import Any

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.page_messages import PageMessage, parse_message
from dora_systemd.decisions.gateway.request import Request, Socket
from dora_systemd.decisions.views.snapshot import observed_values
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.live.act import act, read_graph
from dora_systemd.gateway.live.follow import follow_lines
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name
from dora_systemd.verbs.facts.snapshot import read_snapshot

INTERVAL_SECONDS = 2.0
SEND_SECONDS = 10.0
"""Close the connection of a page that accepts no data for this long; others would queue forever."""
MAX_TASKS = 8
"""Maximum parallel questions and actions of one page."""


async def talk(socket: Socket, request: Request) -> None:
    """Serve one page until it disconnects."""
    page = _Page(socket, request.scope)
    jobs = {asyncio.ensure_future(page.show()), asyncio.ensure_future(page.listen())}
    try:
        done, _ = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
        with suppress(TimeoutError):  # the page takes no data
            for job in done:
                job.result()
    finally:
        await _end(jobs | page.tasks)


async def _end(tasks: set["asyncio.Task[None]"]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


class _Page:
    """One page in a browser."""

    def __init__(self, socket: Socket, scope: Scope) -> None:
        self._socket = socket
        self._scope = scope
        self._is_due = asyncio.Event()
        self._follower: asyncio.Task[None] | None = None
        self.tasks: set[asyncio.Task[None]] = set()

    async def show(self) -> None:
        """Send snapshots, forever."""
        await self._send(type="hello", **_greeting(self._scope))
        while True:
            self._is_due.clear()
            await self._send_snapshot()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._is_due.wait(), INTERVAL_SECONDS)

    async def listen(self) -> None:
        """Handle the messages of the page until it disconnects."""
        async for text in self._socket:
            try:
                self._take(parse_message(text))
            except DoraSystemdError as error:
                await self._send(type="problem", text=error.message, hint=error.hint)

    def _take(self, message: PageMessage) -> None:
        if message.type in ("follow", "unfollow"):
            if self._follower:
                self._follower.cancel()
            self._follower = None
        if message.type == "follow":
            self._follower = self._spawn(self._follow(message))
        elif message.type == "graph":
            self._spawn(self._send_graph(message))
        elif message.type == "act":
            self._spawn(self._act(message))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        if len(self.tasks) >= MAX_TASKS:
            work.close()
            problem = f"cannot start another action: {len(self.tasks)} are still running"
            raise DoraSystemdError(problem, "wait until one of them has finished")
        task = asyncio.ensure_future(work)
        self.tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: "asyncio.Task[None]") -> None:
        self.tasks.discard(task)
        if not task.cancelled():
            # The page has disconnected; listen() notices that too.
            task.exception()

    async def _send_snapshot(self) -> None:
        try:
            values = await asyncio.to_thread(_snapshot, self._scope)
        except DoraSystemdError as error:
            await self._send(type="problem", text=error.message, hint=error.hint)
        else:
            await self._send(type="snapshot", dataflows=values)

    async def _follow(self, message: PageMessage) -> None:
        try:
            async with aclosing(follow_lines(self._scope, message)) as batches:
                async for lines, skipped in batches:
                    values = {"number": message.number, "lines": lines, "skipped": skipped}
                    await self._send(type="lines", **values)
        except DoraSystemdError as error:
            await self._send(type="problem", text=error.message, hint=error.hint)

    async def _send_graph(self, message: PageMessage) -> None:
        values: dict[str, Any] = {"nodes": [], "edges": [], "problem": ""}
        try:
            values |= await asyncio.to_thread(read_graph, self._scope, message.dataflow)
        except DoraSystemdError as error:
            values["problem"] = error.message
        await self._send(type="graph", dataflow=message.dataflow, **values)

    async def _act(self, message: PageMessage) -> None:
        answer = {"text": "", "problem": "", "hint": ""}
        try:
            answer["text"] = await asyncio.to_thread(act, self._scope, message)
        except DoraSystemdError as error:
            answer |= {"problem": error.message, "hint": error.hint}
        self._is_due.set()
        await self._send(type="acted", number=message.number, **answer)

    async def _send(self, **values: Any) -> None:
        async with asyncio.timeout(SEND_SECONDS):
            await self._socket.send(json.dumps(values))


def _greeting(scope: Scope) -> dict[str, str]:
    whose = user_name(scope.uid, nameless="") if scope.is_user else "system"
    return {"version": __version__, "host": sockets.gethostname(), "scope": whose}


def _snapshot(scope: Scope) -> list[dict[str, Any]]:
    found = read_snapshot(Bus(scope, for_reading=True), scope, is_whole=True)
    return [observed_values(one) for one in found]
