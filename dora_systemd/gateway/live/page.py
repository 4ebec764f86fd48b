"""/api/live: the WebSocket of the status page; page_messages.py defines its messages."""

import asyncio
import json
import socket as sockets
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from contextlib import aclosing, suppress
from typing import Any, NamedTuple

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.page_messages import PageMessage, parse_message, saved_line
from dora_systemd.decisions.gateway.request import Request, Socket
from dora_systemd.decisions.views.snapshot import observed_values
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.live.about import (
    read_about,
    read_ended,
    read_own_bundles,
    read_own_releases,
    read_waits,
)
from dora_systemd.gateway.live.actions import act, read_graph
from dora_systemd.gateway.live.lines import (
    MAX_FOUND,
    MAX_LINES,
    MAX_SAVED,
    Lines,
    find_lines,
    follow_lines,
)
from dora_systemd.gateway.live.past import read_timeline
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name
from dora_systemd.verbs.facts.host import read_host
from dora_systemd.verbs.top import read_snapshot

INTERVAL_SECONDS = 2.0
LONGEST_SECONDS = 10.0
"""Between snapshots, of any number of dataflows."""
SHARE = 0.02
"""Maximum share of one CPU for the snapshots of a page; with many dataflows the interval grows."""
MAX_TASKS = 16
"""Maximum parallel questions and actions of one page."""

QUESTIONS: Mapping[str, Callable[[Scope, str], dict[str, Any]]] = {
    "graph": read_graph,
    "about": read_about,
    "ended": read_ended,
    "releases": read_own_releases,
    "timeline": read_timeline,
    "bundles": read_own_bundles,
    "waits": read_waits,
}
_STREAMS = ("follow", "find", "unfollow")
"""Messages that start or end a stream of lines; each ends the stream before it."""


class Means(NamedTuple):
    """The parameters by which a page is served."""

    interval: float = INTERVAL_SECONDS  # seconds between snapshots, at least
    send_seconds: float = 10.0  # until a page that accepts no data is given up, not queued for ever
    questions: Mapping[str, Callable[[Scope, str], dict[str, Any]]] = QUESTIONS
    follow: Callable[[Scope, PageMessage], AsyncGenerator[tuple[Lines, int], None]] = follow_lines
    find: Callable[[Scope, PageMessage, int], Awaitable[tuple[Lines, bool]]] = find_lines


_MEANS = Means()


async def talk(socket: Socket, request: Request, means: Means = _MEANS) -> None:
    """Serve one page until it disconnects."""
    page = Page(socket, request.scope, means)
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


class Page:
    """One page in a browser. is_due: set when the page needs a snapshot."""

    def __init__(self, socket: Socket, scope: Scope, means: Means = _MEANS) -> None:
        self._socket = socket
        self._scope = scope
        self._means = means
        self.is_due = asyncio.Event()
        self._stream: asyncio.Task[None] | None = None
        self.tasks: set[asyncio.Task[None]] = set()
        # The last answer to a question is what the page shows: it must be the newest.
        self._turns = {question: asyncio.Lock() for question in means.questions}

    async def show(self) -> None:
        """Send snapshots, forever."""
        await self._send(type="hello", **_greeting(self._scope))
        while True:
            self.is_due.clear()
            before = time.process_time()
            await self._send_snapshot()
            pause = pause_after(time.process_time() - before, self._means.interval)
            with suppress(TimeoutError):
                async with asyncio.timeout(pause):
                    await self.is_due.wait()

    async def listen(self) -> None:
        """Handle the messages of the page until it disconnects."""
        async for text in self._socket:
            try:
                self._take(parse_message(text))
            except DoraSystemdError as error:
                await self._send(type="problem", text=error.message, hint=error.hint)

    def _take(self, message: PageMessage) -> None:
        if message.type in _STREAMS and self._stream:
            self._stream.cancel()
            self._stream = None
        works = {"follow": self._follow, "find": self._find, "save": self._save, "act": self._act}
        if message.type != "unfollow":
            task = self._spawn(works.get(message.type, self._answer)(message))
            self._stream = task if message.type in _STREAMS else self._stream

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
            await self._send(type="snapshot", **values)

    async def _follow(self, message: PageMessage) -> None:
        try:
            async with aclosing(self._means.follow(self._scope, message)) as batches:
                async for lines, skipped in batches:
                    values = {"number": message.number, "lines": lines, "skipped": skipped}
                    await self._send(type="lines", **values)
        except DoraSystemdError as error:
            await self._send_found(message, error=error)

    async def _find(self, message: PageMessage) -> None:
        async for part in self._parts(message, MAX_FOUND):
            await self._send(type="lines", number=message.number, lines=part, skipped=0)

    async def _save(self, message: PageMessage) -> None:
        async for part in self._parts(message, MAX_SAVED):
            text = "".join(map(saved_line, part))
            await self._send(type="file", number=message.number, text=text)

    async def _parts(self, message: PageMessage, most: int) -> AsyncIterator[Lines]:
        """Yield the lines that a search has found, in parts; then send its result to the page."""
        try:
            found, is_whole = await self._means.find(self._scope, message, most)
        except DoraSystemdError as error:
            await self._send_found(message, error=error)
            return
        for start in range(0, len(found), MAX_LINES):
            yield found[start : start + MAX_LINES]
        await self._send_found(message, len(found), is_whole)

    async def _send_found(
        self,
        message: PageMessage,
        count: int = 0,
        is_whole: bool = False,
        error: DoraSystemdError | None = None,
    ) -> None:
        problem, hint = (error.message, error.hint) if error else ("", "")
        values = {"count": count, "is_whole": is_whole, "problem": problem, "hint": hint}
        await self._send(type="found", number=message.number, **values)

    async def _answer(self, message: PageMessage) -> None:
        values: dict[str, Any] = {"problem": ""}
        async with self._turns[message.type]:
            try:
                read = self._means.questions[message.type]
                values |= await asyncio.to_thread(read, self._scope, message.dataflow)
            except DoraSystemdError as error:
                values["problem"] = error.message
            await self._send(type=message.type, dataflow=message.dataflow, **values)

    async def _act(self, message: PageMessage) -> None:
        answer = {"text": "", "problem": "", "hint": ""}
        try:
            answer["text"] = await asyncio.to_thread(act, self._scope, message)
        except DoraSystemdError as error:
            answer |= {"problem": error.message, "hint": error.hint}
        self.is_due.set()
        await self._send(type="acted", number=message.number, **answer)

    async def _send(self, **values: Any) -> None:
        async with asyncio.timeout(self._means.send_seconds):
            await self._socket.send(json.dumps(values))


def pause_after(on_cpu: float, interval: float = INTERVAL_SECONDS) -> float:
    """Seconds until the next snapshot. on_cpu: seconds of a processor that the last one took."""
    return min(max(interval, on_cpu / SHARE), LONGEST_SECONDS)


def _greeting(scope: Scope) -> dict[str, str]:
    whose = user_name(scope.uid, nameless="") if scope.is_user else "system"
    return {"version": __version__, "host": sockets.gethostname(), "scope": whose}


def _snapshot(scope: Scope) -> dict[str, Any]:
    found = read_snapshot(Bus(scope, for_reading=True), scope, is_whole=True)
    return {"dataflows": list(map(observed_values, found)), "host": read_host().values()}
