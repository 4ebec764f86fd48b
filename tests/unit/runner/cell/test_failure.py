"""Every exception in the runner becomes a reason that a person can read."""

import asyncio
import logging
from collections.abc import Callable
from functools import partial

import pytest

from dora_systemd.decisions.life import events as life
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.failure import Beside, Tasks, failed, say, words
from tests.unit.fakes.loop import live, settle


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (KeyError("uuid"), "KeyError: 'uuid'"),
        (ValueError(), "ValueError"),
        (ValueError("a\n  b\tc"), "ValueError: a b c"),
        (OSError(28, "No space left on device"), "OSError: [Errno 28] No space left on device"),
    ],
)
def test_an_exception_in_one_line(error: Exception, line: str) -> None:
    assert words(error) == line


def test_the_journal_gets_where_it_was_raised(capfd: pytest.CaptureFixture[str]) -> None:
    """At debug level, and each line of it: what has none would be of level info."""
    try:
        raise RuntimeError("no\nsocket")
    except RuntimeError as error:
        event = failed("serve its socket", error)
    assert (event.what, event.error) == ("serve its socket", "RuntimeError: no socket")
    assert event.at_us > 0
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "<7>Traceback (most recent call last):"
    assert lines[1].startswith('<7>  File "')
    assert lines[-2:] == ["<7>RuntimeError: no", "<7>socket"]
    assert all(line.startswith("<7>") for line in lines)


def test_an_error_of_ours_needs_no_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    event = failed("start the daemon", DoraSystemdError("cannot run dora", "install it"))
    assert (event.what, event.error) == ("start the daemon", "cannot run dora")
    assert capfd.readouterr().err == ""


def test_what_is_said_is_a_line(capfd: pytest.CaptureFixture[str]) -> None:
    say("<4>x")
    assert capfd.readouterr().err == "<4>x\n"


class Noted(Tasks):
    """Tasks whose exceptions are in `noted`."""

    def __init__(self) -> None:
        super().__init__()
        self.noted: list[tuple[str, Exception]] = []

    async def raised(self, what: str, error: Exception) -> None:
        self.noted.append((what, error))


def test_an_exception_of_a_task_is_told_with_what_it_did() -> None:
    error = ValueError("x")

    async def fail() -> None:
        raise error

    async def work() -> None:
        tasks = Noted()
        tasks.spawn("take samples", fail())
        tasks.spawn("wait", asyncio.sleep(0))
        await settle()
        assert tasks.noted == [("take samples", error)]
        with pytest.raises(NotImplementedError):
            await Tasks().raised("x", error)

    live(work)


def test_tasks_that_are_given_up_raise_nothing() -> None:
    async def work() -> None:
        tasks, before = Noted(), asyncio.all_tasks()
        for _ in range(3):
            tasks.spawn("wait", asyncio.sleep(100))
        await settle()
        assert len(asyncio.all_tasks()) == len(before) + 3
        tasks.cancel()
        await settle()
        assert (asyncio.all_tasks(), tasks.noted) == (before, [])

    live(work)


def test_a_run_that_begins_later_gets_the_same_event() -> None:
    """And the first one, once: it has ended by then."""

    async def work() -> None:
        first: list[life.Event] = []
        second: list[life.Event] = []
        beside = Beside(asyncio.get_running_loop())
        beside.attach(first.append)
        assert not first
        await beside.raised("serve its socket", RuntimeError("no socket"))
        beside.attach(second.append)
        (event,) = first
        assert isinstance(event, life.Failed)
        assert (event.what, event.error) == ("serve its socket", "RuntimeError: no socket")
        assert second == first

    live(work)


def refuse() -> None:
    raise OSError(11, "busy")


class Handler:
    """Something that can be called, without a name."""

    def __call__(self) -> None:
        refuse()


@pytest.mark.parametrize(
    ("callback", "name"),
    [(refuse, "refuse"), (partial(refuse), "refuse"), (Handler(), "a callback")],
)
def test_a_callback_of_the_loop_has_a_name(callback: Callable[[], None], name: str) -> None:
    async def work() -> None:
        heard: list[life.Event] = []
        beside, loop = Beside(asyncio.get_running_loop()), asyncio.get_running_loop()
        loop.call_soon(callback)
        await settle()
        beside.attach(heard.append)
        assert not heard, "a callback that raised between two runs is no task that they lack"
        loop.call_soon(callback)
        await settle()
        (event,) = heard
        assert isinstance(event, life.Failed)
        assert (event.what, event.error) == (f"finish {name}", "BlockingIOError: [Errno 11] busy")

    live(work)


def test_what_is_no_callback_is_logged_as_asyncio_does(caplog: pytest.LogCaptureFixture) -> None:
    async def work() -> None:
        heard: list[life.Event] = []
        loop = asyncio.get_running_loop()
        Beside(loop).attach(heard.append)
        loop.call_exception_handler({"message": "a future was lost"})
        assert not heard

    with caplog.at_level(logging.ERROR, "asyncio"):
        live(work)
    assert "a future was lost" in caplog.text
