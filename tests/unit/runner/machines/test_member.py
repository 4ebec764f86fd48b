"""A member: what it says to the head, and what it does without one."""

import asyncio
import hashlib
import subprocess
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Thread, current_thread
from typing import Any

import pytest

from dora_systemd.adapters.runner_socket.listener import Ends
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import NodeRights, rights_of
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Do, GiveTime, State
from dora_systemd.decisions.machines import wire
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.machines.member import Member, with_left
from dora_systemd.runner.machines.member_dialogue import MemberDialogue, find_pids, times_left
from dora_systemd.runner.machines.shared import MemberEngine, Patience
from dora_systemd.values import SECOND
from tests.unit.fakes.boots import told_boot
from tests.unit.fakes.dialogue import Heard
from tests.unit.fakes.ends import FakeEnds
from tests.unit.fakes.loop import live
from tests.unit.fakes.manager import with_rights
from tests.unit.fakes.run import FakeNodes, FakePipes

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions(
    *("robot", UUID, "/srv/flow.yml", "/srv", "/bin/dora"),
    placed=(Placed("mid", "gpu"), Placed("eye", "cam")),
    machine="gpu",
)
PART = wire.Part(
    *("robot", UUID, "gpu", "secret", 61000, 61002, "abcd", 2 * SECOND, "0.1.0", "1.1.0")
)


class FakeEngine(MemberEngine):
    """is_cut_off: its daemon was killed."""

    is_cut_off = False

    def cut_off(self) -> None:
        self.is_cut_off = True


class Bench:
    def __init__(self, root: Path, state: State) -> None:
        paths = CellPaths(root)
        self.boot = told_boot(OPTIONS, root, PART)
        self.comes = asyncio.get_running_loop().create_future()
        self.member = Member(OPTIONS, Life("uuid"), self.boot, self.take_over)
        self.member._version = "1.1.4"
        self.pipes = FakePipes()
        self.nodes = FakeNodes(root, self.pipes)
        (root / "io").mkdir()
        cell = Cell(2 * SECOND, 0, {"mid": NodeStatus("running", 7)}, state, run="run")
        self.pump = Heard(self.member.cell(cell), Life("uuid"), paths, self.nodes, self.pipes)
        self.pump.heard, self.pump.calls = [], []
        self.member.engine("/bin/dora", paths, {}, None)
        dora = FakeEngine("/bin/dora", paths, {})
        dialogue = self.member.dialogue(OPTIONS, self.pump, dora, self.nodes, self.pipes)
        assert isinstance(dialogue, MemberDialogue)
        self.dialogue, self.dora = dialogue, dora
        self.actions = dialogue.actions({"nodes": []}, {})

    def be(self, **changes: Any) -> None:
        self.pump.cell = replace(self.pump.cell, **changes)

    async def take_over(self, _boot: object) -> Ends:
        ends: Ends = await self.comes
        return ends

    async def head(self, part: wire.Part = PART) -> FakeEnds:
        """A head that has sent its part."""
        other = FakeEnds()
        self.boot.part = part
        self.comes.set_result(other.ends)
        await settle()
        return other

    @property
    def has_ended(self) -> bool:
        """Whether its nodes were ended without dora."""
        return ("kill",) in self.nodes.calls

    def heard(self) -> list[life.Event]:
        return [replace(one, at_us=0) for one in self.pump.heard]


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


def run(
    root: Path, work: Callable[[Bench], Coroutine[Any, Any, None]], state: State = State.BOOTING
) -> None:
    async def on_loop() -> None:
        bench = Bench(root, state)
        await work(bench)
        await settle()

    live(on_loop)


def test_a_part_begins_its_life(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        assert bench.heard() == [life.CoordinatorListening(0)]
        assert other.heard(without="") == [{"type": "beat"}]
        assert not bench.dora._paths.control.exists()
        other.reader.feed_eof()
        await settle()
        assert bench.heard()[1:] == [life.HeadLost(0, "the connection has ended")]

    run(tmp_path, work)


def test_it_joins_the_run_of_the_head_and_asks_dora_for_none(tmp_path: Path) -> None:
    """It would take the events that dora has for the head."""

    async def work(bench: Bench) -> None:
        other = await bench.head()
        other.say(wire.Run(UUID))
        await settle()
        bench.actions[Do.GATHER]()
        assert other.heard() == [{"type": "ready", "work": str(bench.nodes.places[1].work)}]
        bench.be(state=State.GATHERING)
        await settle()
        assert not [one for one in bench.heard() if isinstance(one, life.RunStarted)]
        other.say(wire.Run(UUID))
        await settle()
        assert bench.heard()[1:] == [life.RunStarted(0, UUID)]
        assert ("run is", UUID) in bench.pipes.calls

    run(tmp_path, work)


def test_nobody_has_said_what_to_run() -> None:
    with pytest.raises(DoraSystemdError, match="no head says what to run"):
        Member(OPTIONS, Life("uuid"), None)


def test_another_version_of_dora_is_refused(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head(replace(PART, dora="1.0.2"))
        (refused,) = other.heard()
        assert refused["type"] == "refused"
        assert refused["reason"] == "it has dora 1.1.4, the head has 1.0.2"
        assert other.writer.is_closed
        assert isinstance(bench.heard()[0], life.HeadLost)

    run(tmp_path, work)


def test_whether_it_could_start_again(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        flow = tmp_path / "flow.yml"
        flow.write_text("nodes: []")
        bench.member.options = OPTIONS._replace(dataflow=str(flow))
        digest = hashlib.sha256(flow.read_bytes()).hexdigest()

        async def answer(digest: str) -> dict[str, Any]:
            before = len(other.heard())
            other.say(wire.Check(digest))
            while len(other.heard()) == before:
                await asyncio.sleep(0.001)
            return other.heard()[-1]

        assert await answer(digest) == {"type": "checked", "reason": "", "hint": ""}
        broken = DoraSystemdError("src.py: line 1: invalid syntax")
        bench.member.find_own_refusal = lambda: broken
        assert (await answer(digest))["reason"] == broken.message
        other_file = await answer("abcd")
        assert other_file["reason"] == f"{flow} is not the same file as on the head"
        assert other_file["hint"] == "copy the directory of the dataflow to that machine"
        flow.unlink()
        assert await answer(digest) == other_file

    run(tmp_path, work)


def test_what_the_head_says(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        other.say(wire.Asked("mid", "restart", "root"), wire.Asked("mid", "other", "root"))
        other.say(wire.Stopping("SIGTERM"), wire.StopPart(SECOND))
        await settle()
        assert bench.heard()[1:] == [
            life.NodeAsked(0, "mid", "restart", "root"),
            life.HeadStops(0, "SIGTERM"),
            life.HeadLost(0, "the head has lost another machine"),
        ]
        bench.be(stop_by="SIGTERM")
        bench.actions[Do.EXIT]()
        assert other.heard() == [{"type": "ended", "reason": "", "by": "", "failed": 0, "waits": 0}]

    run(tmp_path, work)


def test_a_restart_that_dora_refuses_is_taken_back(tmp_path: Path) -> None:
    """Then a crash of the node is one: nobody has requested that any more."""

    async def work(bench: Bench) -> None:
        other, before = await bench.head(), NodeStatus("running", 7)
        refused = wire.Asked("mid", "", "cannot do that in dora: it is too late")
        other.say(refused, wire.Asked("other", "restart", "root"), refused)
        await settle()
        assert bench.heard()[1:] == []
        for pid in (7, 0):
            bench.be(nodes={"mid": before})
            other.say(wire.Asked("mid", "restart", "root"))
            await settle()
            state = "reloading" if pid else "starting"
            bench.be(nodes={"mid": before._replace(state=state, pid=pid, asked="restart")})
            other.say(refused, refused)
            await settle()
        asked = life.NodeAsked(0, "mid", "restart", "root")
        words = Exit(words="dora: it is too late")
        assert bench.heard()[1:] == [
            *(asked, life.NodeKept(0, "mid", before)),
            *(asked, life.NodeExited(0, "mid", words, will_restart=False)),
        ]

    run(tmp_path, work)


def test_a_stop_that_dora_refuses_is_taken_back(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other, before = await bench.head(), NodeStatus("running", 7)
        stopped = before._replace(state="stopped", asked="stop", asked_by="root")
        for now in (stopped, stopped._replace(pid=0, exit=Exit(words="x"))):
            bench.be(nodes={"mid": before})
            other.say(wire.Asked("mid", "stop", "root"))
            await settle()
            bench.be(nodes={"mid": now})
            other.say(wire.Asked("mid", "", "cannot do that in dora: no connection"))
            await settle()
        asked = life.NodeAsked(0, "mid", "stop", "root")
        assert bench.heard()[1:] == [
            *(asked, life.NodeKept(0, "mid", before)),
            *(asked, life.NodeKept(0, "mid", before._replace(pid=0))),
            life.NodeExited(0, "mid", Exit(words="x"), will_restart=False),
        ]

    run(tmp_path, work)


@pytest.mark.parametrize(("said", "seconds"), [(SECOND // 2, 0.5), (0, 0.0), (3600 * SECOND, 2.0)])
def test_the_head_can_only_shorten_the_grace(said: int, seconds: float, tmp_path: Path) -> None:
    """Its nodes end with those here, and its grace duration began before."""

    async def work(bench: Bench) -> None:
        other = await bench.head()
        other.say(wire.StopPart(said))
        await settle()
        loop = asyncio.get_running_loop()
        begun = loop.time()
        bench.actions[Do.END_NODES]()
        while not bench.has_ended:
            await asyncio.sleep(0.01)
        assert loop.time() - begun == pytest.approx(seconds, abs=0.11)

    command = ["sh", "-c", "trap '' TERM; echo; exec sleep 60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as stubborn:
        assert stubborn.stdout
        stubborn.stdout.readline()
        group = tmp_path / "node-mid"
        group.mkdir()
        (group / "cgroup.procs").write_text(f"{stubborn.pid}\n")
        run(tmp_path, work, State.STOPPING)
        stubborn.kill()


@pytest.mark.parametrize(
    ("is_down", "ended"),
    [
        (False, {"reason": "", "by": "SIGTERM"}),
        (True, {"reason": "the machine is shutting down", "by": ""}),
    ],
)
def test_who_stops_it_here_is_told_but_a_shutdown_is_nobody(
    tmp_path: Path, is_down: bool, ended: dict[str, str]
) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        bench.member.is_going_down = lambda _: is_down
        bench.be(stop_by="SIGTERM")
        bench.actions[Do.EXIT]()
        assert other.heard() == [{"type": "ended", **ended, "failed": 0, "waits": 0}]

    run(tmp_path, work)


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread ends before the loop goes on, because its time would pass at once."""

    async def to_thread(call: Callable[[], Any]) -> Any:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(call).result()

    monkeypatch.setattr(asyncio, "to_thread", to_thread)


@pytest.mark.usefixtures("threads")
def test_systemd_is_asked_beside_the_loop_and_the_head_told_on_it(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        asked: list[Thread] = []

        def is_going_down(is_of_user: bool) -> bool:
            asked.append(current_thread())
            return is_of_user

        bench.member.is_going_down = is_going_down
        bench.be(stop_by="SIGTERM")
        stop = asyncio.create_task(bench.dialogue._stop())
        await settle()
        told = {"reason": "", "by": "SIGTERM", "failed": 0, "waits": 0}
        assert other.heard() == [{"type": "ended", **told}]
        assert not bench.has_ended, "the head has not answered yet"
        other.say(wire.StopPart(SECOND))
        await stop
        (thread,) = asked
        assert thread is not current_thread() and bench.has_ended

    run(tmp_path, work)


@pytest.mark.usefixtures("threads")
def test_a_head_that_does_not_answer_holds_up_no_stop(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.head()
        bench.member.is_going_down = lambda _: False
        bench.be(stop_by="SIGTERM")
        await bench.dialogue._stop()
        assert bench.has_ended

    run(tmp_path, work)


def test_its_own_failure_is_told(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        bench.be(failure="the dora daemon is gone (signal SIGKILL)")
        bench.actions[Do.EXIT]()
        reason = "the dora daemon is gone (signal SIGKILL)"
        told = {"reason": reason, "by": "", "failed": 1, "waits": 0}
        assert other.heard() == [{"type": "ended", **told}]

    run(tmp_path, work)


def test_it_judges_by_its_own_table(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.actions[Do.ASK_RESULT]()
        bench.actions[Do.ASK_SPAWN]()
        assert bench.heard() == []
        bench.be(state=State.CLOSING, nodes={"mid": NodeStatus("failed", 0, exit=exit_of(1))})
        bench.actions[Do.ASK_RESULT]()
        assert bench.heard() == [life.ResultKnown(0, {"mid": exit_of(1)})]

    run(tmp_path, work, State.RUNNING)


def test_a_table_is_sent_when_it_is_new(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        group = tmp_path / "node-mid"
        group.mkdir()
        (group / "memory.current").write_text("4096\n")
        (tmp_path / "node-stranger").mkdir()
        other = await bench.head()
        table = CellStatus(uuid=UUID, nodes={"mid": NodeStatus("running", 7)})
        assert bench.pump.amend(bench.pump.amend(table)) == table, "here the cgroup tells it"
        await asyncio.sleep(1.5)
        await asyncio.sleep(1)
        (told,) = [CellStatus.from_json(one["status"]) for one in other.heard()]
        assert told.uuid == UUID
        (use,) = told.usage.values()
        assert 4096 in use

    run(tmp_path, work)


def test_the_first_processes_are_those_that_the_launchers_note(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING)
        bench.be(nodes={"mid": NodeStatus("starting"), "late": NodeStatus("running", 8)})
        found = asyncio.ensure_future(find_pids(bench.pump, bench.nodes))
        await settle()
        CellPaths(tmp_path).node_pid("mid").write_text("77")
        while not bench.pump.heard:
            await asyncio.sleep(0.01)
        (event,) = bench.pump.heard
        assert isinstance(event, life.NodeSpawned)
        assert (event.node, event.pid) == ("mid", 77)
        bench.be(nodes={"mid": NodeStatus("starting", 77)})
        await found

    asyncio.run(work())


def test_a_daemon_without_a_head_is_killed(tmp_path: Path) -> None:
    """It would look for a coordinator where any user can listen now; nodes have their time."""

    async def work(bench: Bench) -> None:
        bench.actions[Do.END_NODES]()
        assert bench.dora.is_cut_off
        bench.dialogue._child_exited("daemon", exit_of(-9))
        await settle()
        assert not [one for one in bench.heard() if isinstance(one, life.ChildExited)]

    run(tmp_path, work, State.STOPPING)


def test_the_head_hears_why_a_node_is_ended(tmp_path: Path) -> None:
    """dora only tells it of the signal."""

    async def work(bench: Bench) -> None:
        other = await bench.head()
        bench.pump.on_event(life.NodeHung(0, "mid", "no sign of life for 5s", "node-watchdog"))
        bench.pump.on_event(life.NodeReady(0, "mid"))
        told = {"node": "mid", "reason": "no sign of life for 5s", "record": "node-watchdog"}
        assert other.heard() == [{"type": "hung", **told, "pid": 7}]

    run(tmp_path, work)


def test_only_the_head_decides_what_is_essential(tmp_path: Path) -> None:
    """Else the end of the part would come first, and look like the loss of its machine."""
    options = with_rights(OPTIONS, NodeRights("mid", essential=True, nice=5))
    member = Member(options, Life("uuid"), told_boot(options, tmp_path, PART))
    assert rights_of(member.options) == (NodeRights("mid", nice=5),)


def test_its_nodes_stop_in_the_order_of_the_head(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        stops = bench.member.node_stops(bench.pump, bench.dora, bench.nodes, bench.dialogue)
        other = await bench.head()
        other.say(wire.Stopping("SIGTERM", 100 * SECOND), wire.StopNode("mid", SECOND, 9 * SECOND))
        await settle()
        assert bench.heard()[1:] == [
            life.HeadStops(0, "SIGTERM", 100 * SECOND),
            life.NodeTurn(0, "mid", SECOND),
        ]
        bench.be(state=State.STOPPING)
        stops.perform(GiveTime("mid", SECOND))  # the node is stopping
        stops._begin()
        stops.extend("mid", 60 * SECOND)
        (extends,) = [one for one in bench.heard() if isinstance(one, life.NodeExtends)]
        assert extends.wanted <= 9 * SECOND, "others wait for the node"

    run(tmp_path, work, State.RUNNING)


def test_a_part_that_is_stopped_here_waits_for_the_order_of_the_head(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.head()
        bench.member.is_going_down = lambda _: False
        bench.be(state=State.STOPPING, stop_by="SIGTERM")
        stop = asyncio.create_task(bench.dialogue._stop())
        while not (told := other.heard()):
            await asyncio.sleep(0)
        assert told[0]["waits"] == 1
        other.say(wire.Stopping("head", 100 * SECOND))
        await stop
        assert not bench.has_ended
        assert bench.heard()[-1] == life.HeadStops(0, "head", 100 * SECOND)

    run(tmp_path, work, State.RUNNING)


def test_who_has_its_own_time_gets_it_without_a_head_too(tmp_path: Path) -> None:
    """SIGTERM is its stop, and SIGKILL comes when its time is over."""

    async def work(bench: Bench) -> None:
        bench.be(ready_us=1, stops={"mid": NodeStop("mid", 3 * SECOND)})
        loop = asyncio.get_running_loop()
        begun = loop.time()
        bench.actions[Do.ASK_STOP]()
        while not bench.has_ended:
            await asyncio.sleep(0.01)
        # A second for the answer of the head, and its own time.
        assert loop.time() - begun == pytest.approx(4.0, abs=0.2)

    group = tmp_path / "node-mid"
    group.mkdir()
    with subprocess.Popen(["sh", "-c", "trap '' TERM; sleep 60"]) as stubborn:
        (group / "cgroup.procs").write_text(f"{stubborn.pid}\n")
        run(tmp_path, work, State.STOPPING)
        stubborn.kill()


def test_the_time_that_is_left() -> None:
    stops = {"a": NodeStop("a", 5 * SECOND), "b": NodeStop("b", 5 * SECOND), "c": NodeStop("c")}
    cell = Cell(SECOND, 0, {}, ready_us=1, stops=stops)
    assert times_left(cell, {"b": 7 * SECOND}, 4 * SECOND) == {
        "a": Patience(0.0, 5.0),
        "b": Patience(3.0, 0.5),
    }
    assert times_left(replace(cell, ready_us=0), {}, 0) == {}
    table = CellStatus(stop_dues={"b": 7 * SECOND, "c": 1})
    assert with_left(table, 4 * SECOND).stop_dues == {"b": 3 * SECOND, "c": 0}
