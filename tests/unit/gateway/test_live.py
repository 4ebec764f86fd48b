"""One page's connection, with a page of a few lines and nothing behind the gateway."""

import asyncio
import json
import threading
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from dora_systemd.decisions.gateway.page_messages import PageMessage
from dora_systemd.decisions.gateway.request import Request
from dora_systemd.errors import DoraSystemdError
from dora_systemd.gateway.live.lines import MAX_LINES
from dora_systemd.gateway.live.page import MAX_TASKS, Means, Page, pause_after, talk
from dora_systemd.scope import Scope
from tests.unit.fakes.library import FakeSystemd, fake_systemd
from tests.unit.fakes.loop import within
from tests.unit.fakes.manager import UUID, FakeManager, options

REQUEST = Request("/api/live", Scope(True, 1000))
ACT = {"type": "act", "action": "stop", "dataflow": UUID, "number": 1}


class Browser:
    """A page that says what it is told to. is_stuck: it takes nothing any more."""

    def __init__(self) -> None:
        self.inbox: asyncio.Queue[str | None] = asyncio.Queue()
        self.got: list[dict[str, Any]] = []
        self.is_stuck = False

    async def send(self, message: str | bytes | AsyncIterable[str]) -> None:
        assert isinstance(message, str)
        while self.is_stuck:
            await asyncio.sleep(1)
        self.got.append(json.loads(message))

    async def recv(self) -> str:
        raise NotImplementedError

    async def close(self, code: int = 1000, reason: str = "") -> None:
        raise NotImplementedError

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        while (text := await self.inbox.get()) is not None:
            yield text

    def say(self, **message: Any) -> None:
        self.inbox.put_nowait(json.dumps(message))

    def leave(self) -> None:
        self.inbox.put_nowait(None)

    async def wait_for(self, kind: str, count: int = 1) -> list[dict[str, Any]]:
        async with asyncio.timeout(60):
            while len(found := [one for one in self.got if one["type"] == kind]) < count:
                await asyncio.sleep(0.005)
        return found


Story = Callable[[Browser], Awaitable[None]]


def play(story: Story, **means: Any) -> Browser:
    """A page that looks very often. means: others than the real ones."""

    async def both() -> Browser:
        browser = Browser()
        talking = asyncio.ensure_future(talk(browser, REQUEST, Means(0.01, **means)))
        await story(browser)
        browser.leave()
        await within(60, talking)
        assert len(asyncio.all_tasks()) == 1
        return browser

    return asyncio.run(both())


@pytest.fixture(autouse=True)
def systemd(monkeypatch: pytest.MonkeyPatch) -> FakeSystemd:
    """A systemd with the dataflow robot."""
    manager = FakeManager()
    manager.add(options(), active="failed")
    return fake_systemd(monkeypatch, manager)


def test_greeting_and_snapshots() -> None:
    async def story(browser: Browser) -> None:
        await browser.wait_for("snapshot", 3)

    got = play(story).got
    assert got[0]["type"] == "hello"
    assert {"version", "host", "scope"} <= got[0].keys()
    assert got[1]["type"] == "snapshot"
    assert [one["name"] for one in got[1]["dataflows"]] == ["robot"]


def test_systemd_out_of_reach(systemd: FakeSystemd) -> None:
    def fail(_pattern: str) -> list[Any]:
        raise DoraSystemdError("cannot reach systemd", "see systemctl")

    systemd.manager = cast(FakeManager, SimpleNamespace(list_units=fail))

    async def story(browser: Browser) -> None:
        first, second = await browser.wait_for("problem", 2)
        assert first == second
        assert first["hint"] == "see systemctl"

    play(story)


def test_garbage_ends_nothing() -> None:
    async def story(browser: Browser) -> None:
        for text in ("", "[]", '{"type": "x"}'):
            browser.inbox.put_nowait(text)
        problems = await browser.wait_for("problem", 3)
        assert {one["text"] for one in problems} == {"cannot read what the page sent"}
        await browser.wait_for("snapshot", len(browser.got) + 2)

    play(story)


def test_actions(systemd: FakeSystemd) -> None:
    async def story(browser: Browser) -> None:
        browser.say(**ACT | {"action": "restart"})
        await browser.wait_for("acted")
        browser.say(**ACT | {"dataflow": "x", "number": 2})
        await browser.wait_for("acted", 2)

    found = {one["number"]: one for one in play(story).got if one["type"] == "acted"}
    assert found[1]["text"] == f"Dataflow restarted: {UUID} (robot)"
    assert found[2]["problem"] == "no dataflow named 'x'"
    assert found[2]["hint"] == "known dataflows: robot"
    assert ("RestartUnit", "dora-robot.service") in systemd.manager.calls


def test_what_is_followed_takes_the_place_of_the_last() -> None:
    followed: list[str] = []

    async def follow(_scope: Scope, message: PageMessage) -> AsyncIterator[tuple[list[Any], int]]:
        followed.append(f"+{message.node}")
        try:
            while True:
                yield [{"text": message.node}], 0
                await asyncio.sleep(0.01)
        finally:
            followed.append(f"-{message.node}")

    async def story(browser: Browser) -> None:
        browser.say(type="follow", node="a", number=1)
        await browser.wait_for("lines")
        browser.say(type="follow", node="b", number=2)
        while browser.got[-1].get("number") != 2:
            await asyncio.sleep(0.005)
        browser.say(type="unfollow")
        await browser.wait_for("snapshot", len(browser.got) + 2)
        assert followed == ["+a", "-a", "+b", "-b"]

    play(story, follow=follow)


def test_questions() -> None:
    def refuse(_scope: Scope, uuid: str) -> dict[str, Any]:
        raise DoraSystemdError(f"no dataflow named {uuid!r}")

    answers = {"about": lambda *_: {"row": {}, "problem": "x"}, "graph": refuse}

    async def story(browser: Browser) -> None:
        browser.say(type="about", dataflow=UUID)
        browser.say(type="graph", dataflow="y")
        assert await browser.wait_for("about") == [
            {"type": "about", "dataflow": UUID, "row": {}, "problem": "x"}
        ]
        (graph,) = await browser.wait_for("graph")
        assert (graph["dataflow"], graph["problem"]) == ("y", "no dataflow named 'y'")

    play(story, questions=answers)


def test_a_search_comes_in_parts_and_ends_the_stream() -> None:
    lines = [{"at_us": at, "node": "a", "text": str(at)} for at in range(MAX_LINES + 1)]

    async def find(_scope: Scope, message: PageMessage, most: int) -> tuple[list[Any], bool]:
        if message.since == "x":
            raise DoraSystemdError("cannot read the time", "see systemd.time(7)")
        return lines[:most], False

    async def story(browser: Browser) -> None:
        browser.say(type="find", number=1)
        (found,) = await browser.wait_for("found")
        assert (found["count"], found["is_whole"], found["problem"]) == (len(lines), False, "")
        parts = [one["lines"] for one in browser.got if one["type"] == "lines"]
        assert [len(part) for part in parts] == [MAX_LINES, 1]
        browser.say(type="save", number=2)
        await browser.wait_for("found", 2)
        text = "".join(one["text"] for one in browser.got if one["type"] == "file")
        assert text.count("\n") == len(lines)
        browser.say(type="find", number=3, since="x")
        *_, problem = await browser.wait_for("found", 3)
        assert (problem["number"], problem["problem"]) == (3, "cannot read the time")
        assert problem["hint"] == "see systemd.time(7)"

    play(story, find=find)


def test_not_too_much_at_once(systemd: FakeSystemd) -> None:
    systemd.is_slow = True

    async def story(browser: Browser) -> None:
        for _ in range(MAX_TASKS + 1):
            browser.say(**ACT | {"action": "restart"})
        (problem,) = await browser.wait_for("problem")
        assert problem["text"] == f"cannot start another action: {MAX_TASKS} are still running"
        assert not await browser.wait_for("acted", 0)
        systemd.finish()
        await browser.wait_for("acted", MAX_TASKS)

    play(story)


def test_a_page_that_takes_nothing_is_given_up() -> None:
    async def both() -> None:
        browser = Browser()
        browser.is_stuck = True
        await within(60, talk(browser, REQUEST, Means(send_seconds=0.05)))
        assert len(asyncio.all_tasks()) == 1
        assert not browser.got

    asyncio.run(both())


@pytest.mark.parametrize("turns", range(6))
def test_a_page_that_leaves_at_the_moment_of_a_change_ends(turns: int) -> None:
    async def both() -> None:
        browser = Browser()
        page = Page(browser, REQUEST.scope, Means(60))
        showing = asyncio.ensure_future(page.show())
        await browser.wait_for("snapshot")
        page.is_due.set()
        for _ in range(turns):
            await asyncio.sleep(0)
        showing.cancel()
        await asyncio.wait({showing}, timeout=10)
        assert showing.cancelled()

    asyncio.run(both())


@pytest.mark.parametrize(("on_cpu", "seconds"), [(0.0, 2.0), (0.04, 2.0), (0.1, 5.0), (1.0, 10.0)])
def test_many_dataflows_are_looked_at_less_often(on_cpu: float, seconds: float) -> None:
    assert pause_after(on_cpu) == pytest.approx(seconds)


def test_the_newest_answer_comes_last() -> None:
    """What an action has changed must not be hidden by a slow answer of before."""
    began, may_end = threading.Event(), threading.Event()
    answers = iter(["old", "new"])

    def read(_scope: Scope, _uuid: str) -> dict[str, Any]:
        value = next(answers)
        began.set()
        if value == "old":
            assert may_end.wait(10)
        return {"value": value}

    async def story(browser: Browser) -> None:
        browser.say(type="about", dataflow=UUID)
        await asyncio.to_thread(began.wait, 10)
        browser.say(type="about", dataflow=UUID)
        await asyncio.sleep(0.05)
        may_end.set()
        found = await browser.wait_for("about", 2)
        assert [one["value"] for one in found] == ["old", "new"]

    play(story, questions={"about": read})
