"""A head: it waits for its members, and does without dora when one is lost."""

import asyncio
import hashlib
import json
import socket
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora.protocol import LogRecord
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.decisions.machines import wire
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.machines.head import Head, HeadDialogue
from dora_systemd.runner.machines.roster import Roster
from dora_systemd.runner.machines.shared import SharedEngine
from dora_systemd.values import SECOND
from tests.unit.fakes.dialogue import Heard
from tests.unit.fakes.ends import FakeEnds
from tests.unit.fakes.loop import live
from tests.unit.fakes.run import FakeDora, FakeNodes, FakePipes

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions(
    *("robot", UUID, "/srv/flow.yml", "/srv", "/bin/dora"), placed=(Placed("mid", "gpu"),)
)
PORTS = wire.Forwards(61000, {"head": 61001, "gpu": 61002})
READY = wire.Ready("/run/there/work")
NODES = {
    "here": NodeStatus("running", 7),
    "mid": NodeStatus("running", 0, machine="gpu"),
}
MID = ("daemon", "mid")


class FakeHead(FakeDora, SharedEngine):
    """daemons: of which machines dora has one; "" is that of the head. age: µs of each."""

    daemons: list[str]
    age = 0
    when_asked: Callable[[], object] = staticmethod(lambda: None)

    async def heartbeats(self) -> list[tuple[str, int]]:
        self.when_asked()
        return [(machine, self.age) for machine in self.daemons]


class Bench:
    def __init__(self, root: Path, is_awaited: bool = True, **options: Any) -> None:
        self.pipes = FakePipes()
        self.nodes = FakeNodes(root, self.pipes)
        (root / "io").mkdir()
        self.dora = FakeHead()
        self.dora.daemons = ["", "gpu"]
        given = OPTIONS._replace(**options)
        self.roster = Roster(given, PORTS)
        cell = Cell(2 * SECOND, 0, NODES, State.GATHERING, run="run", members=("gpu",))
        self.pump = Heard(cell, Life("uuid"), CellPaths(root), self.nodes, self.pipes)
        self.pump.heard, self.pump.calls = [], []
        self.roster.push = self.pump.push
        self.roster.is_awaited = is_awaited
        own = self.pump, self.dora, self.nodes, self.pipes
        self.dialogue = HeadDialogue(given, *own, self.roster)
        self.actions = self.dialogue.actions({"nodes": []}, {})

    @property
    def ended(self) -> int:
        """How often its nodes were ended without dora."""
        return self.nodes.calls.count(("kill",))

    async def link(self, *said: wire.Message) -> FakeEnds:
        other = FakeEnds()
        self.talk = asyncio.create_task(self.roster.link({"machine": "gpu"}, other.ends))
        other.say(*said)
        await settle()
        return other

    def be(self, state: State, **changes: Any) -> None:
        self.pump.cell = replace(self.pump.cell, state=state, **changes)

    def heard(self, *kinds: type[life.Event]) -> list[life.Event]:
        return [replace(one, at_us=0) for one in self.pump.heard if isinstance(one, kinds)]

    def texts(self) -> list[str]:
        heard = (one for one in self.pump.heard if isinstance(one, life.MachinesAwaited))
        return list(dict.fromkeys(one.text for one in heard))


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


Work = Callable[[], Coroutine[Any, Any, None]]


def run(
    root: Path,
    work: Callable[[Bench], Coroutine[Any, Any, None]],
    on: Callable[[Work], None] = live,
    **options: Any,
) -> None:
    async def on_loop() -> None:
        bench = Bench(root, **options)
        try:
            await work(bench)
        finally:
            bench.dialogue.cancel()

    on(on_loop)


def with_threads(work: Work) -> None:
    """Run `work` on a usual loop: files are read in a thread, and an impatient one has no time."""
    asyncio.run(work())


def test_it_goes_on_when_all_have_joined(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        await settle()
        assert bench.texts() == ["waiting for machine gpu (it is not connected yet)"]
        await bench.link(READY)
        await settle()
        assert bench.heard(life.Gathered) == [life.Gathered(0)]

    run(tmp_path, work)


def test_members_join_its_run_when_it_receives_the_events(tmp_path: Path) -> None:
    """dora gives the pids of the nodes here to the first who subscribes, and to nobody else."""

    async def work(bench: Bench) -> None:
        head = Head(OPTIONS, Life("uuid"), None)
        head.roster = bench.roster
        head.dialogue(OPTIONS, bench.pump, bench.dora, bench.nodes, bench.pipes)
        other = await bench.link(READY)
        bench.be(State.STARTING, run=UUID)
        bench.pump.on_event(life.RunStarted(0, UUID))
        (forwards,) = other.heard()
        assert forwards["type"] == "forwards"
        bench.pump.on_event(life.Subscribed(0))
        assert other.heard()[1:] == [{"type": "run", "run": UUID}]

    run(tmp_path, work)


def test_without_ssh_each_address_has_to_be_reached(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        with socket.create_server(("127.0.0.3", 0)) as one:
            port = one.getsockname()[1]
        bench.roster._ports = replace(PORTS, zenoh={"head": 61001, "gpu": port})
        bench.actions[Do.GATHER]()
        await bench.link(READY)
        why = f"cannot connect to 127.0.0.3:{port}: Connection refused"
        while f"waiting for machine gpu ({why})" not in bench.texts():
            await asyncio.sleep(0.01)
        assert not bench.heard(life.Gathered)
        with socket.create_server(("127.0.0.3", port)):
            while not bench.heard(life.Gathered):
                await asyncio.sleep(0.01)

    run(tmp_path, work, addresses=("127.0.0.1", "127.0.0.3"))


def test_a_daemon_that_dora_has_not_forgotten_is_waited_out(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.dora.daemons = ["", "gpu", "gpu"]
        bench.actions[Do.GATHER]()
        await bench.link(READY)
        await asyncio.sleep(1)
        assert not bench.heard(life.Gathered)
        bench.dora.daemons = ["gpu", ""]
        await asyncio.sleep(1)
        assert bench.heard(life.Gathered)

    run(tmp_path, work)


def test_the_first_start_does_not_wait_without_end(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        other = await bench.link(wire.Lost("connect to host b port 22: No route to host"))
        other.reader.feed_eof()
        await asyncio.sleep(29)
        assert not bench.heard(life.Refused)
        await asyncio.sleep(2)
        (refused,) = bench.heard(life.Refused)
        assert isinstance(refused, life.Refused)
        assert refused.cause is Cause.NO_MACHINE
        assert "cannot reach machine gpu (connect to host b port 22: No route" in refused.reason
        assert refused.reason.endswith("no answer within 30s")

    run(tmp_path, work)


def test_a_later_start_does(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        await asyncio.sleep(3000)
        assert not bench.heard(life.Refused)
        await bench.link(READY)
        await settle()
        assert bench.heard(life.Gathered)

    run(tmp_path, work, is_awaited=False)


def test_the_start_timeout_begins_when_all_have_joined(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        await asyncio.sleep(100)
        await bench.link(READY)
        await asyncio.sleep(1)
        assert not bench.heard(life.StartTimedOut)
        bench.be(State.WAITING)
        await asyncio.sleep(5)
        assert bench.heard(life.StartTimedOut)

    run(tmp_path, work, is_awaited=False, start_timeout=5 * SECOND)


def test_a_stop_asks_dora_while_all_are_there(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link(READY)
        bench.be(State.STOPPING, stop_by="SIGTERM")
        bench.dora.answers["Stop"].append({})
        bench.actions[Do.ASK_STOP]()
        await settle()
        assert {"type": "stopping", "by": "SIGTERM", "limit": 0} in other.heard()
        assert bench.heard(life.StopAnswered)
        assert not bench.ended

    run(tmp_path, work)


def test_a_stop_does_not_ask_dora_if_one_is_silent(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.be(State.STOPPING, stop_by="SIGTERM")
        bench.actions[Do.ASK_STOP]()
        await settle()
        assert bench.heard(life.MachineLost) == [life.MachineLost(0, "gpu", "it does not answer")]
        bench.actions[Do.END_NODES]()  # as the table wants after that event
        await settle()
        assert bench.ended == 1
        assert not bench.dora.asked

    run(tmp_path, work)


def test_a_machine_that_falls_silent_during_a_stop_is_not_waited_for(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.link(READY)
        bench.be(State.STOPPING, stop_by="SIGTERM")
        bench.actions[Do.ASK_STOP]()
        await asyncio.sleep(2)
        assert not bench.heard(life.MachineLost)
        await asyncio.sleep(2)
        assert bench.heard(life.MachineLost) == [life.MachineLost(0, "gpu", "it does not answer")]

    run(tmp_path, work)


def test_a_daemon_that_is_gone_is_a_lost_machine(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        other = await bench.link(READY)
        await asyncio.sleep(0.5)
        bench.be(State.RUNNING)
        bench.dora.daemons = [""]
        for _ in range(4):
            await asyncio.sleep(1)
            other.say(wire.Beat())
        reason = "its dora daemon is not connected any more"
        lost = life.MachineLost(0, "gpu", reason, is_failure=True)
        assert lost in bench.heard(life.MachineLost)

    run(tmp_path, work)


def test_the_word_of_a_member_explains_more_than_dora(tmp_path: Path) -> None:
    """The member may say why its daemon is gone a moment after dora has noticed that."""

    async def work(bench: Bench) -> None:
        bench.actions[Do.GATHER]()
        other = await bench.link(READY)
        await asyncio.sleep(0.5)
        bench.be(State.RUNNING)
        bench.dora.daemons = [""]
        word = wire.Ended("the dora daemon is gone (signal SIGKILL)")
        later = asyncio.get_running_loop().call_later
        bench.dora.when_asked = lambda: later(0.5, other.say, word)
        for _ in range(4):
            await asyncio.sleep(1)
            other.say(wire.Beat())
        assert bench.heard(life.MachineLost)[0] == life.MachineLost(0, "gpu", word.reason)

    run(tmp_path, work)


def test_a_daemon_that_hangs_is_a_lost_machine(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.be(State.RUNNING)
        bench.dora.age = 21 * SECOND
        lost = ("gpu", "its dora daemon does not answer any more")
        assert await bench.dialogue._find_lost() == lost
        bench.dora.age = 19 * SECOND
        assert await bench.dialogue._find_lost() is None

    run(tmp_path, work)


def test_an_exit_of_a_process_that_dora_has_replaced(tmp_path: Path) -> None:
    """The head cannot see whether a newer process of the node is there: dora says so."""

    async def work(bench: Bench) -> None:
        bench.be(State.RUNNING)
        said = "handling node stop with exit status Success (restart: false"
        stale = "ignoring stale exit from pid 7 (generation 2); `mid` has been removed or replaced"
        bench.dialogue._hear(LogRecord("DEBUG", *MID, said))
        bench.dialogue._hear(LogRecord("DEBUG", *MID, stale))
        (event,) = bench.heard(life.NodeExited)
        assert isinstance(event, life.NodeExited)
        assert event.is_stale

    run(tmp_path, work)


def test_a_pid_of_another_machine_means_nothing_here(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.be(State.RUNNING)
        bench.dialogue._hear(LogRecord("DEBUG", "spawner", "mid", "spawned node with pid 1"))
        said = "handling node stop with exit status Signal(9) (restart: false"
        bench.dialogue._hear(LogRecord("DEBUG", *MID, said))
        bench.dialogue._hear(LogRecord("INFO", *MID, "its next words"))
        assert bench.heard(life.NodeSpawned) == [life.NodeSpawned(0, "mid", 0)]
        assert bench.roster.pids == {"mid": 1}
        assert bench.heard(life.NodeExited) == [life.NodeExited(0, "mid", exit_of(-9), False)]
        assert bench.nodes.calls == [], "no process here is touched"

    run(tmp_path, work)


@pytest.mark.parametrize("next_words", ["its next words", "spawned node with pid 9"])
def test_an_abort_waits_for_the_word_of_the_member(tmp_path: Path, next_words: str) -> None:
    """The member says by another way that the node has missed its watchdog."""
    said = "handling node stop with exit status Signal(6) (restart: false"

    async def work(bench: Bench) -> None:
        bench.be(State.RUNNING)
        bench.dialogue._hear(LogRecord("DEBUG", *MID, said))
        bench.dialogue._hear(LogRecord("DEBUG", *MID, next_words))
        is_spawned = next_words.startswith("spawned")
        assert bool(bench.heard(life.NodeExited)) is is_spawned, "a new process is its next life"
        other = await bench.link(wire.Hung("mid", "no WATCHDOG=1 for 2s", "node-watchdog"))
        await asyncio.sleep(1.1)
        kinds = [type(one) for one in bench.pump.heard if one]
        assert kinds.count(life.NodeExited) == 1
        assert is_spawned or kinds.index(life.NodeHung) < kinds.index(life.NodeExited)
        other.say(wire.Beat())

    run(tmp_path, work)


def test_a_member_learns_that_dora_has_refused_a_restart(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        del bench
        head, other = Head(OPTIONS, Life("uuid"), None), FakeEnds()
        talk = asyncio.create_task(head.roster.link({"machine": "gpu"}, other.ends))
        await settle()
        head.tell_refused("", "here", "it is too late")
        head.tell_refused("gpu", "mid", "it is too late")
        told = [one for one in other.heard() if one["type"] == "asked"]
        assert told == [{"type": "asked", "node": "mid", "what": "", "by": "it is too late"}]
        talk.cancel()

    run(tmp_path, work)


def test_a_member_with_another_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "sink.py").write_text("new")
    (tmp_path / "same.py").write_text("same")

    async def work(bench: Bench) -> None:
        digests = {
            "sink.py": hashlib.sha256(b"old").hexdigest(),
            "same.py": hashlib.sha256(b"same").hexdigest(),
            "there.py": hashlib.sha256(b"there").hexdigest(),
        }
        await bench.link(READY, wire.Programs(json.dumps(digests)))
        while not bench.heard(life.ReloadNoted):
            await asyncio.sleep(0.01)
        notice = "machine gpu runs another sink.py than the one here"
        assert bench.heard(life.ReloadNoted) == [life.ReloadNoted(0, notice)]
        assert bench.pipes.reasons("machine-differs") == [notice]

    run(tmp_path, work, with_threads, dataflow=str(tmp_path / "flow.yml"))
