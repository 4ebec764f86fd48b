"""What the runner has dora do when somebody asks for a restart or a stop of one node."""

import asyncio
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.dora.preparation import prepare
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import LATCHED, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.machine_role import Alone
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.nodes.launcher_gates import Gates
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.settings_file import SettingsFile
from dora_systemd.runner.requests import NodeRequests, Recheck, end_held
from dora_systemd.values import SECOND
from tests.unit.fakes.loop import live
from tests.unit.fakes.programs import make_dora
from tests.unit.fakes.reload import EXCHANGES, ReloadBench

RUNNING = NodeStatus("running", 7, policy="on-failure", max_restarts=2)
BACKOFF = RUNNING._replace(state="restarting", pid=0, restarts=1)
WAITING = RUNNING._replace(needs="/dev/cam", state="waiting")
SPENT = RUNNING._replace(restarts=2)
NEVER = RUNNING._replace(policy="never", max_restarts=0)
BY = "root (doractl node stop)"


LINES = ("a, outputs: [o]", "b, inputs: {i: a/o}", "c, inputs: {t: dora/timer/millis/10}")


class Role(Alone):
    """Records what it passes on to the machine of a node."""

    def __init__(self, options: RunnerOptions) -> None:
        super().__init__(options, Life("uuid"))
        self.refused: list[tuple[str, str, str]] = []

    def tell_refused(self, machine: str, node: str, reason: str) -> None:
        self.refused.append((machine, node, reason))


class AskedBench(ReloadBench):
    """Node a, which b reads, and c, which nobody reads; they end with an error."""

    def __init__(
        self,
        root: Path,
        state: State = State.RUNNING,
        extend: Callable[[int], object] = int,
        **nodes: NodeStatus,
    ) -> None:
        super().__init__(root, state, **{"a": RUNNING, "c": RUNNING, **nodes})
        (root / "io").mkdir()
        self.gates = self.nodes.gates = Gates(CellPaths(root))
        lines = "".join(f"  - {{path: {one[0]}.py, id: {one}}}\n" for one in LINES)
        self.flow.write_text(f"nodes:\n{lines}")
        reloader = Reloader(self.options, {}, SettingsFile("none.yml", root / "kept.yml"))
        reloader.begin(self.run, prepare(self.options, {}), 0)
        self.role = Role(self.options)
        self.requests = NodeRequests(reloader, self.role, extend)

    def end(self) -> None:
        self.pump.push(
            life.NodeExited(1, self.node, exit_of(3), self.asked[-1][0] == "RestartNode")
        )

    def spawn(self) -> None:
        self.pump.push(life.NodeSpawned(2, self.node, 8))
        if not self.is_gated(self.node):
            self.pump.push(life.NodeReady(3, self.node))

    def is_gated(self, node: str) -> bool:
        return CellPaths(self.root).node_gate(node).exists() and not self.gates.is_passing(node)

    async def ask(self, what: str, node: str, **more: Any) -> str:
        request = {"verb": "node", "what": what, "node": node, "by": BY, **more}
        (done,) = (await self.requests.answer(request))["done"]
        return str(done)

    def status(self, node: str) -> NodeStatus:
        return self.pump.cell.nodes[node]

    def events(self) -> list[str]:
        return [name for name, _, _ in self.pipes.events]


def run(root: Path, scene: Callable[[AskedBench], Awaitable[None]], **more: Any) -> AskedBench:
    """The bench after a scene, which runs in a loop."""

    async def work() -> AskedBench:
        bench = AskedBench(root, **more)
        await scene(bench)
        return bench

    return asyncio.run(work())


LATCHED_ONE = RUNNING._replace(state="failed", pid=0, policy=LATCHED)


@pytest.mark.parametrize(
    ("is_read", "before", "methods"), [*EXCHANGES, (True, LATCHED_ONE, ["ReplaceNode"])]
)
def test_a_restart_begins_at_once_with_all_restarts(
    tmp_path: Path, is_read: bool, before: NodeStatus, methods: list[str]
) -> None:
    """A reload does the same, see test_apply.py."""
    node = "a" if is_read else "c"

    async def scene(bench: AskedBench) -> None:
        assert await bench.ask("restart", node) == f"Node restarting: {node}"

    bench = run(tmp_path, scene, **{node: before})
    assert [method for method, *_ in bench.asked] == methods
    after = bench.status(node)
    assert (after.state, after.restarts, after.asked) == ("running", 0, "")
    assert bench.events()[0] == "node-asked", "it is written before anything is done"
    assert not {"node-crashed", "node-restarted"} & {*bench.events()}


def test_a_restart_that_dora_refuses_because_the_node_is_just_being_started(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.dora.refuses["RestartNode"] = "not in a restartable state"
        await bench.ask("restart", "a")

    bench = run(tmp_path, scene, a=RUNNING._replace(state="starting"))
    assert bench.status("a").state == "running"


def test_a_node_that_dora_does_not_add_again_has_failed(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.dora.refuses["AddNode"] = "it is too late"
        with pytest.raises(DoraSystemdError, match="it is too late"):
            await bench.ask("restart", "c")

    bench = run(tmp_path, scene)
    assert bench.status("c").state == "failed"
    assert str(bench.status("c").exit) == "dora: it is too late"


@pytest.mark.parametrize("is_late", [False, True], ids=["before", "after"])
def test_a_node_that_fails_just_before_dora_replaces_it(tmp_path: Path, is_late: bool) -> None:
    """Its own exit is the cause, also if dora's refusal overtakes it."""

    async def scene(bench: AskedBench) -> None:
        def fail() -> None:
            bench.pump.push(life.NodeExited(1, "a", exit_of(1), False))

        def follow(event: life.Event) -> None:
            if isinstance(event, life.NodeAsked):
                fail()

        refusal = "no running node `a` to replace; use `dora node add`"
        bench.dora.refuses["ReplaceNode"] = refusal
        if not is_late:
            bench.pump.on_event = follow
        with pytest.raises(DoraSystemdError, match="no running node"):
            await bench.ask("restart", "a")
        if is_late:
            fail()

    bench = run(tmp_path, scene, a=NEVER)
    assert (bench.status("a").state, bench.status("a").exit) == ("failed", exit_of(1))
    assert bench.events()[-1] == "node-crashed"


def test_a_node_that_dora_does_not_replace_runs_on(tmp_path: Path) -> None:
    """Then a crash of it is one: nobody has requested that any more."""

    async def scene(bench: AskedBench) -> None:
        bench.dora.refuses["ReplaceNode"] = "replacement adds input `i`"
        with pytest.raises(DoraSystemdError, match="adds input"):
            await bench.ask("restart", "a")

    bench = run(tmp_path, scene, a=NEVER)
    assert bench.status("a") == NEVER
    ((_, node, reason),) = bench.role.refused
    assert (node, reason) == ("a", "cannot do that in dora: replacement adds input `i`")


AFAR = RUNNING._replace(pid=0, machine="gpu")


@pytest.mark.parametrize("before", [RUNNING, AFAR, BACKOFF, SPENT], ids=str)
@pytest.mark.parametrize("node", ["a", "c"])
def test_a_stop_that_dora_refuses_is_taken_back(
    tmp_path: Path, node: str, before: NodeStatus
) -> None:
    """Else a node that runs is shown as stopped, and a crash of it counts as the requested end."""
    is_held = node == "a" and not before.machine

    async def scene(bench: AskedBench) -> None:
        methods = ("RestartNode", "ReplaceNode") if is_held else ("RemoveNode",)
        bench.dora.refuses = dict.fromkeys(methods, "no connection for daemon gpu")
        with pytest.raises(DoraSystemdError, match="cannot do that in dora: no connection"):
            await bench.ask("stop", node)
        assert bench.status(node) == before
        assert bench.gates.is_passing(node) is is_held, "dora's next process has to start"
        bench.dora.refuses = {}
        assert await bench.ask("stop", node) == f"Node stopping: {node}"

    bench = run(tmp_path, scene, **{node: before})
    reason = "cannot do that in dora: no connection for daemon gpu"
    assert bench.role.refused == [(before.machine, node, reason)]
    assert bench.status(node).state == "stopped"


@pytest.mark.parametrize("how", [exit_of(1), Exit()], ids=["failed", "finished"])
def test_a_node_that_ends_by_itself_just_before_its_stop(tmp_path: Path, how: Exit) -> None:
    async def scene(bench: AskedBench) -> None:
        def follow(event: life.Event) -> None:
            if isinstance(event, life.NodeAsked):
                bench.pump.push(life.NodeExited(1, "c", how, False))

        bench.pump.on_event = follow
        bench.dora.refuses["RemoveNode"] = "node `c` not found in running dataflow"
        with pytest.raises(DoraSystemdError, match="not found"):
            await bench.ask("stop", "c")

    after = run(tmp_path, scene).status("c")
    assert (after.state, after.exit) == ("failed" if how.is_failure else "finished", how)
    assert not after.asked


@pytest.mark.parametrize(("is_job", "times"), [(True, 4), (False, 0)])
def test_a_slow_reload_extends_the_timeout_of_its_job(
    tmp_path: Path, is_job: bool, times: int
) -> None:
    """The next process of c is not ready in its 30 s."""
    extended: list[int] = []

    async def work() -> None:
        bench = AskedBench(tmp_path, extend=extended.append)
        bench.dora.then["AddNode"] = lambda: bench.pump.push(life.NodeSpawned(2, "c", 8))
        with pytest.raises(DoraSystemdError, match="not ready within 30s"):
            await bench.requests.answer({"verb": "reload", "node": "c", "is_job": is_job})
        await asyncio.sleep(60)

    live(work)
    assert extended == times * [30 * SECOND], "systemd gives it 30 s from each message"


def test_a_stop_of_the_dataflow_that_comes_meanwhile(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        def stop() -> None:
            bench.pump.push(life.StopAsked(1, "SIGTERM"))
            bench.end()

        bench.dora.then["RemoveNode"] = stop
        await bench.ask("restart", "c")

    bench = run(tmp_path, scene)
    assert bench.asked == [("RemoveNode", "c")]
    assert bench.status("c").state == "stopped"


def test_the_next_process_after_a_restart_can_crash(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.dora.then["AddNode"] = bench.crash
        await bench.ask("restart", "c")

    bench = run(tmp_path, scene)
    assert bench.status("c").state == "failed"
    assert bench.events().count("node-crashed") == 1


@pytest.mark.parametrize("before", [RUNNING, SPENT, NEVER, BACKOFF], ids=str)
@pytest.mark.parametrize("node", ["a", "c"])
def test_a_stopped_node_is_stopped_until_it_is_restarted(
    tmp_path: Path, node: str, before: NodeStatus
) -> None:
    async def scene(bench: AskedBench) -> None:
        assert await bench.ask("stop", node) == f"Node stopping: {node}"
        after = bench.status(node)
        assert (after.state, after.asked_by, bench.pump.cell.failure) == ("stopped", BY, "")
        assert after.is_held is (node == "a")
        count = len(bench.asked)
        words = f"Node already stopped: {node} (requested by {BY})"
        assert await bench.ask("stop", node) == words
        assert len(bench.asked) == count
        assert await bench.ask("restart", node) == f"Node restarting: {node}"
        if node == "a":  # its launcher goes on
            bench.pump.push(life.NodeReady(4, "a"))

    bench = run(tmp_path, scene, **{node: before})
    assert (bench.status(node).state, bench.status(node).asked) == ("running", "")
    assert not bench.is_gated(node)
    assert "node-crashed" not in bench.events()


@pytest.mark.parametrize(("state", "secs"), [("starting", 0), ("running", 10)])
@pytest.mark.parametrize("what", ["stop", "restart"])
def test_a_node_that_starts_gets_no_time_for_a_message_that_does_not_reach_it(
    tmp_path: Path, state: str, secs: int, what: str
) -> None:
    async def scene(bench: AskedBench) -> None:
        await bench.ask(what, "c", grace=10 * SECOND)

    bench = run(tmp_path, scene, c=RUNNING._replace(state=state))
    assert bench.dora.asked[0] == {
        "RemoveNode": {
            "dataflow_id": "run",
            "node_id": "c",
            "grace_duration": {"secs": secs, "nanos": 0},
        }
    }


def test_a_node_that_becomes_ready_after_its_stop(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.dora.then["RemoveNode"] = lambda: None
        await bench.ask("stop", "c")
        bench.pump.push(life.NodeReady(4, "c"))
        bench.pump.push(life.NodeExited(5, "c", exit_of(1), False))

    bench = run(tmp_path, scene, c=RUNNING._replace(state="starting"))
    assert (bench.status("c").state, bench.status("c").pid) == ("stopped", 0)
    assert "node-crashed" not in bench.events()


def test_a_node_without_a_launcher_is_removed(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.nodes.bare.add("a")
        await bench.ask("stop", "a", grace=5)
        await bench.ask("restart", "a")

    bench = run(tmp_path, scene)
    assert bench.asked == [("RemoveNode", "a"), ("AddNode", "a")]


@pytest.mark.parametrize("state", [State.RUNNING, State.WAITING])
@pytest.mark.parametrize("node", ["a", "c"])
def test_a_node_that_waits(tmp_path: Path, node: str, state: State) -> None:
    async def scene(bench: AskedBench) -> None:
        bench.gates.make([node])
        said = await bench.ask("restart", node)
        assert said.startswith(f"Node waiting: {node} waits for /dev/cam")
        assert not bench.asked
        assert bench.status(node).state == "waiting"
        assert await bench.ask("stop", node) == f"Node stopping: {node}"
        assert bench.status(node).state == "stopped"
        if state is State.RUNNING:
            await bench.ask("restart", node)
            assert bench.is_gated(node), "its needs open it"

    bench = run(tmp_path, scene, state=state, **{node: WAITING})
    is_held = node == "a" and state is State.RUNNING
    assert bool(bench.asked) is not is_held
    assert "node-crashed" not in bench.events()


def test_a_start_can_go_on_without_a_node_that_waits(tmp_path: Path) -> None:
    """dora would wait for its launcher."""

    async def scene(bench: AskedBench) -> None:
        bench.gates.make(["a"])
        await bench.ask("stop", "a")

    bench = run(tmp_path, scene, state=State.WAITING, a=WAITING)
    assert bench.asked == [("RemoveNode", "a")]


@pytest.mark.parametrize(
    ("what", "state", "status", "message"),
    [
        ("restart", State.RUNNING, {"state": "finished"}, "it has ended .finished.$"),
        ("restart", State.RUNNING, {"state": "failed", "exit": exit_of(1)}, "failed: exit code 1"),
        ("restart", State.WAITING, {}, "^cannot restart a: not all nodes are ready yet"),
        ("stop", State.WAITING, {}, "^cannot stop a: not all nodes are ready yet"),
        ("restart", State.STARTING, {}, "not all nodes are ready yet"),
        ("restart", State.GATHERING, {}, "not all nodes are ready yet"),
        ("stop", State.STOPPING, {}, "^cannot stop a: the dataflow is stopping"),
        ("stop", State.RUNNING, {"kind": "dynamic", "state": "dynamic"}, "dynamic node"),
        ("kill", State.RUNNING, {}, "cannot do"),
    ],
)
def test_what_is_refused_changes_nothing(
    tmp_path: Path, what: str, state: State, status: dict[str, Any], message: str
) -> None:
    async def scene(bench: AskedBench) -> None:
        before = bench.pump.cell
        with pytest.raises(DoraSystemdError, match=message):
            await bench.ask(what, "a")
        assert bench.pump.cell is before

    bench = run(tmp_path, scene, state=state, a=RUNNING._replace(**status))
    assert not bench.asked
    assert not bench.events()


def test_a_node_that_is_not_there(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        with pytest.raises(DoraSystemdError, match="cannot find a node 'x'") as caught:
            await bench.ask("stop", "x")
        assert caught.value.code is ExitCode.NOT_FOUND

    run(tmp_path, scene)


@pytest.mark.parametrize("state", ["finished", "failed"])
def test_a_stop_of_what_has_ended_says_so(tmp_path: Path, state: str) -> None:
    async def scene(bench: AskedBench) -> None:
        assert await bench.ask("stop", "a") == f"Node not running: a ({state})"

    assert not run(tmp_path, scene, a=RUNNING._replace(state=state, pid=0)).asked


def test_the_dataflow_ends_when_all_but_stopped_nodes_have_ended(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        ending = asyncio.create_task(end_held(bench.run))
        await bench.ask("stop", "a")
        await asyncio.sleep(0)
        assert not ending.done()
        for node in ("b", "c"):
            bench.pump.push(life.NodeExited(5, node, exit_of(0), False))
        await ending

    bench = run(tmp_path, scene)
    assert not bench.gates.is_passing("a"), "its launcher has to leave"


def test_other_requests_are_for_reloads(tmp_path: Path) -> None:
    async def scene(bench: AskedBench) -> None:
        assert await bench.requests.answer({"verb": "hot-reload", "on": False}) == {"done": []}

    run(tmp_path, scene)


FLOW = "nodes: [{id: a, path: a.py, outputs: [x]}]"


@pytest.fixture
def options(tmp_path: Path) -> RunnerOptions:
    (tmp_path / "a.py").write_text("import b\n")
    (tmp_path / "b.py").write_text("")
    (flow := tmp_path / "robot.yml").write_text(FLOW)
    return RunnerOptions(
        "robot", "", str(flow), str(tmp_path), make_dora(tmp_path / "dora", "1.1.0")
    )


def ask(options: RunnerOptions, **request: Any) -> dict[str, Any]:
    async def others(request: Any) -> dict[str, Any]:
        return {"done": [request["verb"]]}

    role = Alone(options, Life(options.uuid))
    return asyncio.run(Recheck(role, os.environ, others).answer(request))


def test_what_could_start(options: RunnerOptions) -> None:
    assert ask(options, verb="check") == {"refused": None}


def test_all_other_requests(options: RunnerOptions) -> None:
    assert ask(options, verb="reload") == {"done": ["reload"]}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("robot.yml", FLOW.replace("path:", "pth:"), "node a has no path"),
        ("a.py", "def (", "line 1: invalid syntax"),
        ("b.py", "def (", "line 1: invalid syntax"),
        ("robot.yml", "", "robot.yml"),
    ],
)
def test_what_could_not(options: RunnerOptions, name: str, text: str, words: str) -> None:
    Path(options.working_directory, name).write_text(text)
    refused = ask(options, verb="check")["refused"]
    assert words in refused["error"]
    assert name in refused["error"]


@pytest.mark.parametrize("place", ["project/.venv/dora", "dora"])
def test_a_project_that_is_gone(options: RunnerOptions, tmp_path: Path, place: str) -> None:
    """Its file is named, and neither the dora command nor the directory of a process."""
    project = tmp_path / "project"
    flow = project / "robot.yml"
    dora = make_dora(tmp_path / place, "1.1.0")
    project.mkdir(exist_ok=True)
    flow.write_text(FLOW)
    (project / "a.py").touch()
    placed = options._replace(dataflow=str(flow), working_directory=str(project), dora=dora)
    assert ask(placed, verb="check")["refused"] is None
    project.rename(tmp_path / "elsewhere")
    refused = ask(placed, verb="check")["refused"]
    assert refused["error"] == f"cannot read {flow}: there is no such file"
    assert refused["code"] == ExitCode.BAD_INPUT
