"""The runner's loop: its actions and tasks raise, hang and lie, and the cell ends all the same."""

import asyncio
import os
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.options import RunnerOptions, format_runner_argv
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora.protocol import Reply
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.failure import Beside
from dora_systemd.runner.cell.pump import Pump, is_deleted
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.values import SECOND
from tests.unit.fakes.loop import live

OPTIONS = RunnerOptions("robot", "uuid", "/srv/flow.yml", "/srv", "/bin/dora")


class Side:
    """The nodes, the pipes and the dora of a cell. raises: the methods that do."""

    def __init__(self, *raises: str) -> None:
        self.raises = raises
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.replies: list[Reply] = []
        self.hangs = False
        self.resources = SimpleNamespace(look=lambda *_: [], most=lambda _: {}, is_quiet=False)
        self.notify_sockets = None
        self.stop_dues: dict[str, int] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*_: Any) -> Any:
            if name in self.raises:
                raise OSError(24, "Too many open files")
            return {}

        return call

    def write_event(self, name: str, _: str | None, **details: Any) -> None:
        if f"event {name}" in self.raises:
            raise OSError(28, "No space left on device")
        self.events.append((name, details))

    async def wait_quiet(self, _: float) -> None:
        if "wait_quiet" in self.raises:
            raise ValueError("quiet")

    def dismiss_daemon(self) -> bool:
        return False  # it has left already

    async def ask_apart(self, params: Any, seconds: float) -> Reply:
        if self.hangs:
            await asyncio.sleep(seconds)
            raise DoraSystemdError("no reply in time")
        return await self.ask(params)

    async def ask(self, _: Any) -> Reply:
        if not self.replies:
            await asyncio.Event().wait()
        return self.replies.pop(0)


class Bench:
    """A pump and a dialogue at work, on a Side."""

    def __init__(self, root: Path, side: Side, state: State, **changes: Any) -> None:
        self.side = side
        side_: Any = side
        nodes = {"a": NodeStatus("running", 7)}
        cell = Cell(2 * SECOND, 0, nodes, state, run="run", ready_us=1, **changes)
        self.pump = Pump(cell, Life("uuid"), CellPaths(root), side_, side_)
        self.dialogue = Dialogue(OPTIONS, self.pump, side_, side_, side_)

    def connect(self, **others: Callable[[], None]) -> None:
        actions = self.dialogue.actions({"nodes": []}, {})
        self.pump.connect(actions | {Do[name]: action for name, action in others.items()})

    @property
    def reasons(self) -> list[str]:
        ends = [one for name, one in self.side.events if name == "dataflow-failed"]
        return [one["reason"] for one in ends]


def refuse() -> None:
    raise OSError(11, "Resource temporarily unavailable")


EVENTS: dict[Do, tuple[State, life.Event]] = {
    Do.START_DAEMON: (State.BOOTING, life.CoordinatorListening(1)),
    Do.SEND_START: (State.JOINING, life.DaemonConnected(1)),
    Do.SUBSCRIBE: (State.STARTING, life.RunStarted(1, "run")),
    Do.OPEN_PIPES: (State.STARTING, life.Subscribed(1)),
    Do.ASK_SPAWN: (State.STARTING, life.Subscribed(1)),
    Do.ASK_RESULT: (State.RUNNING, life.RunFinished(1)),
    Do.ASK_STOP: (State.RUNNING, life.StopAsked(1, "SIGTERM")),
}


@pytest.mark.parametrize("action", EVENTS)
def test_an_action_that_raises_ends_the_cell(tmp_path: Path, action: Do) -> None:
    state, event = EVENTS[action]

    async def work() -> None:
        bench = Bench(tmp_path, Side(), state)
        bench.connect(**{action.name: refuse})
        bench.pump.push(event)
        assert await bench.pump.end is RunnerExit.FAILED
        assert bench.reasons == [
            f"the runner could not {action.value}: "
            "BlockingIOError: [Errno 11] Resource temporarily unavailable"
        ]

    live(work)


def test_an_error_of_our_own_is_told_in_its_own_words(tmp_path: Path) -> None:
    def refuse() -> None:
        raise DoraSystemdError("cannot write control.json: No space left on device")

    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.BOOTING)
        bench.connect(START_DAEMON=refuse)
        bench.pump.push(life.CoordinatorListening(1))
        assert bench.reasons == [
            "the runner could not start the daemon: "
            "cannot write control.json: No space left on device"
        ]

    live(work)


def test_the_pump_hears_after_something_has_raised(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, Side("drain"), State.LEAVING)
        bench.connect()
        bench.pump.push(life.NodeExited(1, "a", exit_of(1), False))
        assert bench.pump.cell.state is State.ENDED
        assert bench.pump.end.done()

    live(work)


@pytest.mark.parametrize("state", [state for state in State if state is not State.ENDED])
def test_exit_that_raises_is_an_exit_all_the_same(tmp_path: Path, state: State) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, Side("kill", "event dataflow-stopped"), state)
        bench.connect(EXIT=refuse, ASK_STOP=refuse, DISMISS_DAEMON=refuse)
        bench.pump.push(life.StopAsked(1, "SIGTERM"))
        bench.pump.push(life.DeadlinePassed(2))
        bench.pump.push(life.DeadlinePassed(3))
        assert bench.pump.end.done()

    live(work)


def test_nothing_that_can_be_shown_keeps_it_from_ending(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.RUNNING)
        bench.connect()
        bench.side.raises = ("line_counts",)
        bench.pump.push(life.StopAsked(1, "SIGTERM"))
        assert bench.pump.end.done()
        assert "could not show its state" in bench.reasons[0]

    live(work)


def test_a_handler_that_raises_ends_the_cell(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.RUNNING)
        bench.connect()
        bench.pump.push(cast(life.Event, life.ReloadNoted))  # no event at all
        assert bench.pump.end.done()
        assert "could not handle the event" in bench.reasons[0]

    live(work)


@pytest.mark.parametrize("state", [s for s in State if s not in (State.WAITING, State.ENDED)])
def test_what_hangs_ends(tmp_path: Path, state: State) -> None:
    async def work() -> None:
        side = Side()
        side.hangs = True
        bench = Bench(tmp_path, side, state)
        bench.connect()
        if state not in (State.BOOTING, State.JOINING, State.STARTING):
            bench.pump.push(life.StopAsked(1, "SIGTERM"))
        began = asyncio.get_running_loop().time()
        await bench.pump.end
        assert asyncio.get_running_loop().time() - began < 31

    live(work)


LIES: tuple[tuple[State, life.Event, Reply], ...] = (
    (State.RUNNING, life.RunFinished(1), Reply("1", {"DataflowSpawned": 1}, "")),
    (State.RUNNING, life.RunFinished(1), Reply("1", ["x"], "")),
    (State.JOINING, life.DaemonConnected(1), Reply("1", {"DataflowStartTriggered": []}, "")),
)


@pytest.mark.parametrize(("state", "event", "reply"), LIES)
def test_what_lies_ends_the_cell(
    tmp_path: Path, state: State, event: life.Event, reply: Reply
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, Side(), state)
        bench.side.replies = [reply] * 9
        bench.connect()
        bench.pump.push(event)
        async with asyncio.timeout(60):
            await bench.pump.end
        assert bench.reasons

    live(work)


def test_a_task_that_raises_ends_the_cell(tmp_path: Path) -> None:
    async def fail() -> None:
        raise ProcessLookupError(3, "No such process")

    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.RUNNING)
        bench.connect()
        bench.dialogue.spawn("take samples", fail())
        assert await bench.pump.end is RunnerExit.FAILED
        assert bench.reasons == [
            "the runner could not take samples: ProcessLookupError: [Errno 3] No such process"
        ]

    live(work)


async def beside(bench: Bench, cause: Callable[[Beside], Awaitable[None]]) -> None:
    every = Beside(asyncio.get_running_loop())
    every.attach(bench.pump.push)
    bench.connect()
    await cause(every)
    async with asyncio.timeout(60):
        assert await bench.pump.end is RunnerExit.FAILED
    every.cancel()


def test_a_task_beside_all_runs_that_raises_ends_this_one_and_the_next(tmp_path: Path) -> None:
    async def cause(every: Beside) -> None:
        async def fail() -> None:
            raise RuntimeError("no socket")

        every.spawn("serve its socket", fail())

    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.RUNNING)
        await beside(bench, cause)
        assert bench.reasons == ["the runner could not serve its socket: RuntimeError: no socket"]

    live(work)


def test_one_that_raised_between_two_runs_ends_the_next(tmp_path: Path) -> None:
    async def fail() -> None:
        raise RuntimeError("no socket")

    async def work() -> None:
        every = Beside(asyncio.get_running_loop())
        every.spawn("serve its socket", fail())
        await asyncio.sleep(0)
        bench = Bench(tmp_path, Side(), State.BOOTING)
        bench.connect()
        every.attach(bench.pump.push)
        assert bench.pump.end.done()

    live(work)


def test_a_callback_of_the_loop_that_raises_ends_the_cell(tmp_path: Path) -> None:
    async def cause(_: Beside) -> None:
        asyncio.get_running_loop().call_soon(refuse)

    async def work() -> None:
        bench = Bench(tmp_path, Side(), State.RUNNING)
        await beside(bench, cause)
        assert "could not finish refuse: BlockingIOError" in bench.reasons[0]

    live(work)


def test_a_directory_that_was_deleted_under_somebody(tmp_path: Path) -> None:
    """As a mount has it, whose source is gone: it is there, and has no name any more."""
    place = tmp_path / "robot"
    place.mkdir()
    assert not is_deleted(place)
    held = os.open(place, os.O_PATH)
    place.rmdir()
    assert is_deleted(place)
    assert is_deleted(Path(f"/proc/self/fd/{held}"))
    os.close(held)


def test_the_exit_status_does_not_depend_on_who_reads_standard_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = (sys.executable, "-m", "dora_systemd.runner", *format_runner_argv(OPTIONS))
    environment = {key: text for key, text in os.environ.items() if key != "RUNTIME_DIRECTORY"}
    done = subprocess.run(command, stderr=writing, env=environment, check=False)
    os.close(writing)
    assert done.returncode == RunnerExit.BAD_DATAFLOW
