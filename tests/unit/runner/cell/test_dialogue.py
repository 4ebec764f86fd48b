"""What dora is asked and says: every answer becomes its event, and so does every silence."""

import asyncio
import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from dora_systemd.adapters.dora import engine
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.extra import RECORDER
from dora_systemd.decisions.dora.protocol import LogRecord
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Do, State
from dora_systemd.decisions.resources.oom import Oom, Owner
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.clock import Ticks
from tests.unit.fakes.dialogue import DESCRIPTOR, OPTIONS, Bench, Heard
from tests.unit.fakes.loop import ImpatientLoop, live, settle
from tests.unit.fakes.manager import with_texts

ENDED = {"DataflowStopped": {"result": {"node_results": {"a": {"Ok": None}}}}}


def test_a_descriptor_that_dora_takes(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.answers["Start"].append("run-1")
        assert await bench.do(Do.SEND_START) == [life.RunStarted(0, "run-1")]
        assert bench.dora.asked == [{"Start": {"dataflow": DESCRIPTOR, "name": "robot"}}]
        assert bench.calls[0] == ("expect",)
        run, push = bench.calls.index(("run is", "run-1")), ("push", "RunStarted")
        assert run < bench.calls.index(push), "lines have the run before anything follows"

    live(work)


ASKED = [
    (Do.SEND_START, "Start"),
    (Do.ASK_SPAWN, "WaitForSpawn"),
    (Do.ASK_RESULT, "Check"),
    (Do.ASK_STOP, "Stop"),
]


@pytest.mark.parametrize(("do", "request_"), ASKED)
def test_a_connection_that_breaks_is_told_in_its_own_words(
    tmp_path: Path, do: Do, request_: str
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.answers[request_].append(DoraSystemdError("it closed the connection"))
        assert await bench.do(do) == [life.Refused(0, "it closed the connection")]

    live(work)


@pytest.mark.parametrize(("do", "request_"), ASKED)
def test_what_is_no_word_of_ours_is_told_with_what_was_asked(
    tmp_path: Path, do: Do, request_: str
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.answers[request_].append(KeyError("uuid"))
        assert await bench.do(do) == [life.Failed(0, do.value, "KeyError: 'uuid'")]

    live(work)


def test_the_end_of_a_child_comes_before_what_its_connection_suffers(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.answers["Start"].append(DoraSystemdError("it closed the connection"))
        bench.actions[Do.SEND_START]()
        await settle()
        assert not bench.heard
        await asyncio.sleep(1)
        assert bench.heard

    live(work)


@pytest.mark.parametrize("what", ["Start", "the events end"])
def test_an_exit_that_has_begun_explains_a_connection_that_is_lost(
    tmp_path: Path, what: str
) -> None:
    """The kernel closes the connections of a killed process before it reports the end."""

    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.exits = True
        bench.dora.answers["Start"].append(DoraSystemdError("it closed the connection"))
        bench.dora.closed.set()
        bench.actions[Do.SEND_START if what == "Start" else Do.SUBSCRIBE]()
        await asyncio.sleep(1)
        kinds = [type(event) for event in bench.heard]
        assert kinds == ([] if what == "Start" else [life.Subscribed])
        bench.enter(State.ENDED)  # by ChildExited
        await asyncio.sleep(1)
        assert len(bench.heard) == len(kinds) + 1

    live(work)


def test_an_exit_that_takes_long_is_not_awaited_for_ever(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.exits = True
        bench.dora.answers["Start"].append(DoraSystemdError("it closed the connection"))
        bench.actions[Do.SEND_START]()
        await asyncio.sleep(10)
        assert bench.heard == [life.Refused(0, "it closed the connection")]

    live(work)


@pytest.mark.parametrize(
    ("error", "heard"),
    [
        ("failed to spawn a", [life.Refused(0, "failed to spawn a")]),
        ("unknown dataflow run", []),
        ("", []),
    ],
)
def test_nodes_that_cannot_be_executed(tmp_path: Path, error: str, heard: list[Any]) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.refuses = {"WaitForSpawn": error}
        assert await bench.do(Do.ASK_SPAWN) == heard

    live(work)


def test_the_result_is_asked_for_until_it_is_there(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.CLOSING)
        bench.dora.answers["Check"].extend(
            [{"DataflowSpawned": {}}, {"DataflowSpawned": {}}, ENDED]
        )
        assert await bench.do(Do.ASK_RESULT) == [life.ResultKnown(0, {"a": Exit()})]

    live(work)


@pytest.mark.parametrize("texts", [("record=last=10s",), ()], ids=["recorded", "called so"])
def test_the_recorder_is_none_of_the_dataflow(tmp_path: Path, texts: Sequence[str]) -> None:
    results = {"a": {"Ok": None}, RECORDER: {"Ok": None}}
    ended = {"DataflowStopped": {"result": {"node_results": results}}}

    async def work() -> None:
        bench = Bench(tmp_path, State.CLOSING, options=with_texts(OPTIONS, *texts))
        bench.dora.answers["Check"].append(ended)
        (event,) = await bench.do(Do.ASK_RESULT)
        assert isinstance(event, life.ResultKnown)
        assert event.results.keys() == ({"a"} if texts else {"a", RECORDER})
        await bench.do(Do.SUBSCRIBE)
        bench.calls.clear()
        assert bench.dora.hear is not None
        bench.dora.hear(LogRecord("INFO", "daemon", RECORDER, "spawned node with pid 8"))
        adopted = [("adopt", RECORDER, 8), ("push", "NodeSpawned")]
        assert bench.calls == ([] if texts else adopted)

    live(work)


def test_a_run_that_goes_on_is_asked_for_its_result_once(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING)
        bench.dora.answers["Check"].extend([{"DataflowSpawned": {}}, ENDED])
        assert await bench.do(Do.ASK_RESULT) == []
        assert len(bench.dora.asked) == 1

    live(work)


def test_a_stop(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.answers["Stop"].append({})
        assert await bench.do(Do.ASK_STOP) == [life.StopAnswered(0)]
        assert bench.calls[:2] == [("let go",), ("ask", "Stop")]
        assert bench.pipes.expected == ["zzz-dora-systemd-"]
        assert bench.dora.asked == [
            {
                "Stop": {
                    "dataflow_uuid": "run",
                    "grace_duration": {"secs": 2, "nanos": 0},
                    "force": False,
                }
            }
        ]

    live(work)


def test_a_stop_that_is_refused_is_an_answer(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.refuses = {"Stop": "no such run"}
        assert await bench.do(Do.ASK_STOP) == [life.StopAnswered(0)]

    live(work)


@pytest.mark.parametrize("has_daemon", [True, False])
def test_the_daemon_is_dismissed_when_its_nodes_have_said_all(
    tmp_path: Path, has_daemon: bool
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.LEAVING)
        bench.dora.has_daemon = has_daemon
        heard = await bench.do(Do.DISMISS_DAEMON)
        assert bench.calls[:4] == [
            ("let go",),
            ("mute", "coordinator", "daemon"),
            ("wait quiet",),
            ("dismiss",),
        ]
        assert heard == (
            [] if has_daemon else [life.ChildExited(0, "daemon", Exit(words="earlier"))]
        )

    live(work)


def test_pipes_and_exit(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.actions[Do.OPEN_PIPES]()
        assert bench.calls == [("listen", "run")]
        bench.pump.cell = replace(bench.pump.cell, exit=RunnerExit.NODES_FAILED)
        bench.actions[Do.EXIT]()
        assert await bench.pump.end is RunnerExit.NODES_FAILED

    live(work)


def test_the_coordinator_tells_its_port_once(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.BOOTING)
        bench.dialogue.read_coordinator("INFO something")
        assert not bench.heard
        bench.dialogue.read_coordinator("Listening on port 4711")
        assert (bench.dora.port, bench.heard) == (4711, [life.CoordinatorListening(0)])
        bench.enter(State.JOINING)
        bench.dialogue.read_coordinator("Listening on port 1")
        assert bench.dora.port == 4711

    live(work)


def test_a_coordinator_without_a_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with /run full: dora goes on without one."""

    async def work() -> None:
        bench = Bench(tmp_path, State.BOOTING)
        monkeypatch.setattr(bench.dora, "set_port", lambda _: (tmp_path / "none").stat())
        bench.dialogue.read_coordinator("Listening on port 4711")
        (event,) = bench.heard
        assert isinstance(event, life.Failed)
        assert event.what == "use the dora coordinator"
        assert event.error == "it has written no token; df /run shows whether it is full"

    live(work)


@pytest.mark.parametrize("oom", [None, Oom(Owner.DATAFLOW, 1 << 30, 1 << 30)])
def test_the_daemon_from_its_start_to_its_end(tmp_path: Path, oom: Oom | None) -> None:
    given: list[Mapping[str, str]] = []
    children: list[engine.Child] = []

    async def work() -> None:
        bench = Bench(tmp_path, State.JOINING)
        bench.nodes.ooms = {} if oom is None else {"": oom}

        def start(added: Mapping[str, str]) -> engine.Child:
            given.append(added)
            child = engine.spawn("daemon", ["/bin/sh", "-c", "exit 3"], {}, tmp_path)
            children.append(child)
            return child

        bench.dora.daemon = start
        bench.actions[Do.START_DAEMON]()
        bench.dora.joined.set()
        on_line = bench.pipes.outputs["daemon"]
        assert on_line is not None
        on_line("node `a` unresponsive for 5322ms (timeout: 5s), killing")
        async with asyncio.timeout(20):
            while len(bench.heard) < 3:
                await asyncio.sleep(0.005)
        how = exit_of(3) if oom is None else Exit(words=oom.text)
        hung = life.NodeHung(0, "a", "unresponsive for 5322ms (timeout: 5s)")
        assert bench.heard[0] == hung
        assert life.DaemonConnected(0) in bench.heard
        assert life.ChildExited(0, "daemon", how, oom) in bench.heard
        assert given == [{"ADDED": "1"}]
        children[0].close(asyncio.get_running_loop(), 5)
        os.close(children[0].output)

    asyncio.run(work())


def test_a_signal_is_heard_before_the_exit_of_a_child_that_it_has_killed(tmp_path: Path) -> None:
    killed = exit_of(-signal.SIGTERM)

    async def work() -> None:
        bench = Bench(tmp_path)
        child = engine.spawn("daemon", ["/bin/sleep", "60"], {}, tmp_path)
        child.popen.terminate()
        os.waitid(os.P_PID, child.popen.pid, os.WEXITED | os.WNOWAIT)
        loop, stop = asyncio.get_running_loop(), life.StopAsked(0, "SIGTERM")
        loop.add_signal_handler(signal.SIGTERM, bench.pump.push, stop)
        bench.dialogue.watch(child)
        os.kill(os.getpid(), signal.SIGTERM)  # the loop hears of both at once, of this one last
        while len(bench.heard) < 2:
            await asyncio.sleep(0)
        assert bench.heard == [stop, life.ChildExited(0, "daemon", killed)]
        loop.remove_signal_handler(signal.SIGTERM)
        os.close(child.pidfd)
        os.close(child.output)

    asyncio.run(work())


@pytest.mark.parametrize(
    ("state", "silent", "wanted"),
    [
        (State.RUNNING, "", []),
        (
            State.RUNNING,
            "daemon",
            [life.ConnectionLost(0, "daemon", "the dora daemon does not answer any more")],
        ),
        (State.STOPPING, "daemon", []),
    ],
)
def test_dora_is_watched(
    tmp_path: Path, state: State, silent: str, wanted: list[life.Event]
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, state)
        bench.dora.silent = silent
        bench.dialogue.spawn("watch dora", bench.dialogue.watch_dora(Ticks(10), 15))
        await asyncio.sleep(15)
        assert bench.heard == wanted
        assert (("find silent", 15.0) in bench.calls) is (state is State.RUNNING)
        bench.dialogue.cancel()

    live(work)


def test_a_cell_that_was_frozen_gives_dora_time(tmp_path: Path) -> None:
    """dora's coordinator has missed the daemon meanwhile, which registers again."""

    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.dora.silent = "daemon"
        loop = cast(ImpatientLoop, asyncio.get_running_loop())
        bench.dialogue.spawn("watch dora", bench.dialogue.watch_dora(Ticks(10), 15))
        await asyncio.sleep(9)
        loop.jump(40)
        await asyncio.sleep(35)
        assert not bench.heard
        await asyncio.sleep(20)
        assert bench.heard
        bench.dialogue.cancel()

    live(work)


class Sampled(Heard):
    """A pump in which nothing happens but at some samples."""

    def sample(self) -> bool:
        self.at.append(asyncio.get_running_loop().time())
        return len(self.at) not in self.busy

    at: list[float]
    busy: set[int]


@pytest.mark.parametrize(
    ("ticks", "at"), [(15.0, [0, 5, 10, 25, 40, 45]), (None, [0, 5, 10, 15, 20, 25])]
)
def test_samples_wait_for_ticks_while_nothing_happens(
    tmp_path: Path, ticks: float | None, at: list[float]
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, kind=Sampled)
        assert isinstance(bench.pump, Sampled)
        bench.pump.at, bench.pump.busy = [], {1, 2, 5}
        shared = None if ticks is None else Ticks(ticks)
        bench.dialogue.spawn("take samples", bench.dialogue.take_samples(5, shared))
        await asyncio.sleep(46)
        assert bench.pump.at[:6] == at
        bench.dialogue.cancel()

    live(work)


def test_a_restart_is_ready_before_its_delay_is_over(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.JOINING)
        is_over = asyncio.Event()

        async def hold() -> None:
            await is_over.wait()

        bench.dialogue.hold = hold
        child = engine.spawn("daemon", ["/bin/cat"], {}, tmp_path)
        bench.dora.daemon = lambda _: child
        bench.actions[Do.START_DAEMON]()
        bench.dora.joined.set()
        await settle()
        assert life.DaemonConnected(0) not in bench.heard
        is_over.set()
        await settle()
        assert life.DaemonConnected(0) in bench.heard
        bench.dialogue.cancel()
        child.close(asyncio.get_running_loop(), 5)
        os.close(child.output)

    live(work)


def test_what_is_still_asked_is_given_up(tmp_path: Path) -> None:
    async def work() -> None:
        bench, before = Bench(tmp_path), asyncio.all_tasks()
        await bench.do(Do.ASK_SPAWN)
        bench.dialogue.spawn("take samples", bench.dialogue.take_samples(5, Ticks()))
        await settle()
        bench.dialogue.cancel()
        await settle()
        assert asyncio.all_tasks() == before
        assert not bench.heard

    live(work)
