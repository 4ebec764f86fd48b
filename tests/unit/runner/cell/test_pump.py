"""The pump: what the table wants done is done, in its order, and what becomes of it is shown."""

import asyncio
import io
import json
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Do, Record, State
from dora_systemd.decisions.resources.usage import LineCount
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.pump import Pump
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.values import SECOND
from tests.unit.fakes.libraries import hear_notifications, install
from tests.unit.fakes.loop import live
from tests.unit.fakes.run import Calls, FakeNodes, FakePipes

RUNS = {"a": NodeStatus("running", 7)}


class Bench:
    """A pump whose actions only note that they were taken."""

    def __init__(
        self, root: Path, state: State, this_life: Life | None = None, **changes: Any
    ) -> None:
        self.calls: Calls = []
        self.this_life = this_life or Life("uuid")
        self.pipes = FakePipes(self.calls)
        self.nodes = FakeNodes(root, self.pipes, self.calls)
        self.paths = CellPaths(root)
        cell = Cell(2 * SECOND, 0, RUNS, state, **{"run": "run", "ready_us": 1, **changes})
        self.pump = Pump(cell, self.this_life, self.paths, self.nodes, self.pipes)
        self.pump.connect({do: self.note(do) for do in Do})

    def note(self, do: Do) -> Any:
        return lambda: self.calls.append((do,))

    def push(self, *events: life.Event) -> list[Any]:
        """What is done about these events."""
        self.calls.clear()
        for event in events:
            self.pump.push(event)
        return list(self.calls)

    @property
    def table(self) -> Any:
        return json.loads(self.paths.status.read_text())


EVENTS: list[tuple[State, life.Event, list[Do]]] = [
    (State.BOOTING, life.CoordinatorListening(1), [Do.START_DAEMON]),
    (State.JOINING, life.DaemonConnected(1), [Do.SEND_START]),
    (State.STARTING, life.RunStarted(1, "run"), [Do.SUBSCRIBE]),
    (State.STARTING, life.Subscribed(1), [Do.OPEN_PIPES, Do.ASK_SPAWN, Do.ASK_RESULT]),
    (State.RUNNING, life.StopAsked(1, "SIGTERM"), [Do.ASK_STOP]),
    (State.STOPPING, life.StopAnswered(1), [Do.DISMISS_DAEMON]),
    (State.LEAVING, life.ChildExited(1, "daemon", exit_of(0)), [Do.EXIT]),
]


@pytest.mark.parametrize(("state", "event", "wanted"), EVENTS)
def test_every_action_is_taken_once_and_in_order(
    tmp_path: Path, state: State, event: life.Event, wanted: list[Do]
) -> None:
    async def work() -> None:
        done = Bench(tmp_path, state).push(event)
        assert [one[0] for one in done if isinstance(one[0], Do)] == wanted

    live(work)


OF_MACHINES = {Do.GATHER, Do.END_NODES}
"""Those of a dataflow with several machines."""


def test_these_are_all_actions() -> None:
    assert {do for *_, wanted in EVENTS for do in wanted} == set(Do) - OF_MACHINES


@pytest.mark.parametrize(
    ("state", "event", "wanted"),
    [
        (State.LEAVING, life.DeadlinePassed(1), [("kill",), ("event", "dataflow-finished")]),
        (
            State.RUNNING,
            life.NodeExited(1, "a", exit_of(1), False),
            [("drain", "a"), ("event", "node-crashed")],
        ),
        # It may be in the middle of a line.
        (
            State.RUNNING,
            life.NodeReady(1, "a"),
            [("drain live", "a"), ("event", "node-ready")],
        ),
    ],
)
def test_the_last_words_come_before_the_event(
    tmp_path: Path, state: State, event: life.Event, wanted: Calls
) -> None:
    async def work() -> None:
        assert Bench(tmp_path, state).push(event)[:2] == wanted

    live(work)


def test_the_exit_follows_all_that_has_to_be_written(tmp_path: Path) -> None:
    async def work() -> None:
        done = Bench(tmp_path, State.RUNNING).push(life.Refused(1, "no"))
        assert done == [("kill",), ("event", "dataflow-failed"), (Do.EXIT,)]

    live(work)


def test_an_event_that_cannot_be_written_hinders_no_exit(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.pipes.broken = {"dataflow-failed"}
        assert bench.push(life.Refused(1, "no")) == [("kill",), (Do.EXIT,)]
        assert await bench.pump.end is RunnerExit.FAILED

    live(work)


def test_what_an_action_causes_waits_for_the_actions_beside_it(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.STARTING)
        actions = {do: bench.note(do) for do in Do}
        late = life.Refused(1, "cannot be executed")
        actions[Do.OPEN_PIPES] = lambda: bench.pump.push(late)
        bench.pump.connect(actions)
        done = bench.push(life.Subscribed(1))
        kept = [(Do.ASK_SPAWN,), (Do.ASK_RESULT,), ("kill",)]
        assert done[:3] == kept
        assert bench.pump.cell.state is State.ENDED

    live(work)


async def seconds_until_end(bench: Bench) -> float:
    loop = asyncio.get_running_loop()
    began = loop.time()
    await bench.pump.end
    return loop.time() - began


def test_a_state_that_waits_too_long_ends(tmp_path: Path) -> None:
    async def work() -> None:
        assert round(await seconds_until_end(Bench(tmp_path, State.BOOTING))) == 30

    live(work)


def test_the_next_state_has_a_deadline_of_its_own(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.BOOTING)
        await asyncio.sleep(20)
        bench.push(life.CoordinatorListening(1))
        assert round(await seconds_until_end(bench)) == 30

    live(work)


def test_a_state_without_deadline_has_that_of_no_other(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.STARTING)
        bench.push(life.Subscribed(1), life.AllReady(2))
        await asyncio.sleep(3000)
        assert bench.pump.cell.state is State.RUNNING

    live(work)


def test_systemd_is_told_each_state_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = hear_notifications(monkeypatch)
    store = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    store.bind(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING, ready_us=0)
        assert told == ["STATUS=0/1 nodes ready"]
        bench.push(life.AllReady(5))
        assert told.pop() == "READY=1"
        bench.push(life.ReloadNoted(6, "not reloaded: x"), life.ReloadNoted(7, ""))
        assert "READY=1" not in told
        assert "STOPPING=1" not in told
        with pytest.raises(BlockingIOError):
            store.recv(1000)
        bench.push(life.StopAsked(8, "SIGTERM"))
        assert "STOPPING=1" in told
        assert store.recv(1000).startswith(b"FDSTORE=1")
        assert store.recv(1000) == b"FDSTOREREMOVE=1\nFDNAME=dora-life", "no lives are counted"

    with store:
        live(work)


def test_a_stop_before_it_is_ready_ends_as_a_start_that_went_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Systemd refuses READY=1 after STOPPING=1, from version 262 on with a warning."""
    told = hear_notifications(monkeypatch)

    async def work() -> None:
        monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
        bench = Bench(tmp_path, State.WAITING, ready_us=0)
        bench.push(life.StopAsked(8, "SIGTERM"), life.StopAnswered(9))
        bench.push(life.ChildExited(10, "daemon", exit_of(0)))
        assert bench.pump.cell.state is State.ENDED
        assert "READY=1" in told
        assert "STOPPING=1" not in told

    live(work)


def test_the_table_and_the_event_are_there_before_systemd_reports_that_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, tuple[str, bool]] = {}

    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING, ready_us=0)

        def notify(text: str) -> None:
            has_event = ("event", "dataflow-started") in bench.calls
            seen[text] = bench.table["stage"], has_event

        monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
        install(monkeypatch, "systemd.daemon", notify=notify)
        bench.push(life.AllReady(5))
        assert seen["READY=1"] == ("running", True)

    live(work)


def test_the_table_tells_since_when_the_unit_is_up(tmp_path: Path) -> None:
    """From READY=1 on; a reload's next run in the same life changes nothing, as in systemd."""

    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING, ready_us=0)
        assert (bench.table["up_us"], bench.table["is_first"]) == (0, False)
        before = time.monotonic_ns() // 1000
        bench.push(life.AllReady(5))
        up_us = bench.table["up_us"]
        assert before <= up_us <= time.monotonic_ns() // 1000
        again = Bench(tmp_path, State.WAITING, this_life=bench.this_life, ready_us=0)
        again.push(life.AllReady(6))
        assert again.table["up_us"] == up_us

    live(work)


def test_who_waits_for_a_state(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING)
        wait = asyncio.create_task(bench.pump.wait(lambda cell: cell.notice == "x", None))
        late = asyncio.create_task(bench.pump.wait(lambda cell: cell.notice == "y", 5))
        await asyncio.sleep(1)
        assert not wait.done()
        bench.push(life.ReloadNoted(1, "x"))
        assert await wait
        assert await bench.pump.wait(lambda cell: cell.notice == "x", 0)
        assert not await late, "five seconds are over"

    live(work)


def test_a_table_that_cannot_be_written_ends_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    async def work() -> None:
        CellPaths(tmp_path).status.mkdir()
        bench = Bench(tmp_path, State.RUNNING)
        bench.push(life.ReloadNoted(1, "x"), life.ReloadNoted(2, "y"))
        await asyncio.sleep(1)
        assert bench.pump.cell.state is State.RUNNING

    live(work)
    assert capfd.readouterr().err.count("<4>") == 1, "it is said once"


def test_a_lost_directory_ends_the_cell(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path / "gone", State.RUNNING)
        await bench.pump.end
        assert bench.pump.cell.cause is Cause.DIRECTORY_LOST
        assert bench.pump.cell.failure == f"its directory {tmp_path}/gone is gone"

    live(work)


@pytest.mark.parametrize(("state", "count"), [(State.WAITING, 0), (State.RUNNING, 1)])
def test_samples_and_what_is_said_about_them(tmp_path: Path, state: State, count: int) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, state)
        bench.nodes.resources.records = [Record("memory-high", "a", {"reason": "x"})]
        bench.pump.sample()
        assert [name for name, *_ in bench.pipes.events] == ["memory-high"] * count
        assert len(bench.table["samples"]) == 1

    live(work)


@pytest.mark.parametrize(
    ("state", "is_idle", "lines", "is_quiet"),
    [
        (State.RUNNING, True, 0, True),
        (State.RUNNING, True, 1, False),
        (State.RUNNING, False, 0, False),
        (State.WAITING, True, 0, False),
    ],
)
def test_a_sample_says_whether_anything_happens(
    tmp_path: Path, state: State, is_idle: bool, lines: int, is_quiet: bool
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, state)
        bench.pipes.lines = {"a": LineCount(written=5)}
        assert not bench.pump.sample(), "the first one knows nothing of what was before"
        bench.nodes.resources.is_quiet = is_idle
        bench.pipes.lines = {"a": LineCount(written=5 + lines)}
        assert bench.pump.sample() is is_quiet

    live(work)


def test_the_end_of_a_node_says_what_it_has_used(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.nodes.resources.used = {"held_peak": "7"}
        bench.push(life.NodeReady(1, "a"), life.NodeExited(2, "a", exit_of(1), will_restart=False))
        used = [(name, details.get("held_peak")) for name, _, details in bench.pipes.events]
        assert used[:2] == [("node-ready", None), ("node-crashed", "7")]

    live(work)


def test_what_was_so_for_a_moment_was_so(tmp_path: Path) -> None:
    """The task that waits runs after the events: a reload must not wait for a start that was."""

    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        wait = asyncio.create_task(bench.pump.wait(lambda cell: cell.notice == "x", None))
        await asyncio.sleep(0)
        bench.push(life.ReloadNoted(1, "x"), life.ReloadNoted(2, ""))
        assert await wait

    live(work)


def test_a_directory_that_is_lost_after_a_full_disk_ends_the_cell(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    async def work() -> None:
        paths = CellPaths(tmp_path / "cell")
        paths.status.mkdir(parents=True)
        bench = Bench(paths.root, State.RUNNING)
        bench.push(life.ReloadNoted(1, "x"))
        paths.status.rmdir()
        paths.root.rmdir()
        bench.push(life.ReloadNoted(2, "y"))
        await bench.pump.end
        assert bench.pump.cell.cause is Cause.DIRECTORY_LOST

    live(work)
    assert capfd.readouterr().err.count("<4>") == 1


def test_a_warning_that_nobody_reads_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a restart of journald the pipe of standard error may be broken."""
    reading, writing = os.pipe()
    os.close(reading)

    async def work() -> None:
        CellPaths(tmp_path).status.mkdir()
        bench = Bench(tmp_path, State.RUNNING)
        bench.push(life.ReloadNoted(1, "x"))
        bench.pump.sample()
        assert bench.pump.cell.state is State.RUNNING

    with os.fdopen(writing, "wb", buffering=0) as raw:
        text = io.TextIOWrapper(raw, write_through=True)
        monkeypatch.setattr("sys.stderr", text)
        live(work)
        monkeypatch.undo()
        text.detach()
