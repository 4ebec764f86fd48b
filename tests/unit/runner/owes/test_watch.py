"""The watch over owed outputs: the probe is there, and what is silent is acted on, by dora."""

import asyncio
import struct
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from dora_systemd.decisions.cell.extra import PROBE, extra_id
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.failure import Tasks
from dora_systemd.runner.owes.watch import Watch
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.swap import Swapper
from dora_systemd.values import SECOND
from tests.unit.fakes.loop import live
from tests.unit.fakes.manager import with_owes
from tests.unit.fakes.reload import ReloadBench
from tests.unit.fakes.run import Calls, FakeNodes, FakePipes

OWED = Owed("a", "image", 2 * SECOND, 4 * SECOND)


class OwingNodes(FakeNodes):
    """held: nodes that are frozen."""

    def __init__(self, root: Path, pipes: FakePipes, calls: Calls) -> None:
        super().__init__(root, pipes, calls)
        self.held: set[str] = set()

    def is_held(self, node: str) -> bool:
        return node in self.held


class Spawned(Tasks):
    """Tasks beside the watch; none may raise."""

    async def raised(self, what: str, error: Exception) -> None:
        raise AssertionError(what) from error


class Bench(ReloadBench):
    """A watch, and a probe that hears what the test says while it `listens`."""

    def __init__(self, root: Path, *owes: Owed) -> None:
        super().__init__(root)
        self.owing = OwingNodes(root, self.pipes, self.calls)
        self.run = Run(self.pump, self.owing, self.pipes, Swapper(self.pump, self.dora))
        options = with_owes(self.options, *(owes or (OWED,)))
        self.python = "/venv/bin/python"
        plan = self.prepared.plan._replace(options=options)
        changed = self.prepared._replace(plan=plan)
        self.tasks = Spawned()
        self.watch = Watch(self.run, changed, self.dora, self.tasks, self.find_python)
        self.group = root / f"node-{PROBE}"
        self.listens = self.speaks = True
        self.dora.then["AddNode"] = self.populate
        self.dora.then["RestartNode"] = self.restart

    async def find_python(self) -> str:
        if not self.python:
            raise DoraSystemdError("no Python here has dora-rs")
        return self.python

    def populate(self, is_there: bool = True) -> None:
        self.group.mkdir(exist_ok=True)
        (self.group / "cgroup.events").write_text(f"populated {int(is_there)}\nfrozen 0\n")

    def restart(self) -> None:
        self.end()

    async def work(self, seconds: float) -> None:
        """Let it work for that long; the probe beats all the time."""
        task = asyncio.create_task(self.watch.work())
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while loop.time() < end:
            await asyncio.sleep(0.1)
            if self.listens:
                self.note(loop.time())
        assert not task.done() or task.exception() is None
        task.cancel()

    def note(self, now: float) -> None:
        at = int(now * SECOND)
        with CellPaths(self.root).times.open("r+b") as file:
            file.write(struct.pack("=Q", at))
            if self.speaks:
                file.write(struct.pack("=Q", at))

    def named(self, *events: str) -> list[tuple[str, Any]]:
        return [(name, details.get("reason")) for name, _, details in self.pipes.events
                if name in events]  # fmt: skip

    def added(self) -> list[Any]:
        return [one["AddNode"]["node"] for one in self.dora.asked if "AddNode" in one]  # type: ignore[index]

    def graces(self) -> list[Any]:
        asked: list[Any] = [one for one in self.dora.asked if "RestartNode" in one]
        return [one["RestartNode"]["grace_duration"] for one in asked]


def lived(root: Path, work: Callable[[Bench], Coroutine[Any, Any, None]], *owes: Owed) -> Bench:
    benches: list[Bench] = []

    async def begin() -> None:
        await asyncio.sleep(1000)  # a machine that has been up for a while
        benches.append(Bench(root, *owes))
        await work(benches[0])

    live(begin)
    return benches[0]


def test_a_probe_of_its_own(tmp_path: Path) -> None:
    bench = lived(tmp_path, lambda bench: bench.work(30))
    (node,) = bench.added()
    assert node["inputs"] == {"0": {"source": "a/image", "queue_size": 1}}
    words = f"{PROBE} / keep /venv/bin/python -u "
    assert words in node["args"]
    assert str(tmp_path / "times") in node["args"]
    assert not bench.named("node-silent", "outputs-unwatched")
    assert bench.states() == {"a": "running", "b": "running"}


def test_silence_is_a_restart_by_dora_with_its_cause(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.work(5)
        bench.speaks = False
        await bench.work(4)

    bench = lived(tmp_path, work)
    assert bench.named("node-silent") == [("node-silent", "no image for 2s")]
    assert ("RestartNode", "a") in bench.asked
    assert [call for call in bench.calls if call[0] in ("begin", "end")] == [
        ("begin", "a"),
        ("end", "a"),
    ]
    # dora says that it exited with success; it did not do so by itself.
    assert str(bench.pump.cell.nodes["a"].exit) == "silent, no image for 2s"
    assert bench.named("node-ended", "node-crashed") == [("node-ended", None)]
    # It does not wait for the grace duration of the dataflow.
    assert bench.graces() == [{"secs": 1, "nanos": 0}]


def test_a_restart_that_dora_refuses(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.dora.refuses["RestartNode"] = "not in a restartable state"
        await bench.work(5)
        bench.speaks = False
        await bench.work(4)

    bench = lived(tmp_path, work)
    reason = "no image for 2s; dora does not restart it: not in a restartable state"
    assert bench.named("node-silent")[1] == ("node-silent", reason)
    node = bench.pump.cell.nodes["a"]
    assert (node.silent, node.is_ended) == ("no image for 2s", False)


def test_a_warning_and_its_end(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.work(3)
        bench.speaks = False
        await bench.work(20)
        assert bench.pump.cell.nodes["a"].silent == "no image for 2s"
        bench.speaks = True
        await bench.work(1)

    bench = lived(tmp_path, work, OWED._replace(then="warn"))
    assert [name for name, _ in bench.named("node-silent", "node-speaks-again")] == [
        "node-silent",
        "node-speaks-again",
    ]
    assert bench.pump.cell.nodes["a"].silent == ""
    assert bench.asked == [("AddNode", extra_id(PROBE, 1))]


def test_failure_ends_the_dataflow(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.speaks = False
        await bench.work(8)

    cell = lived(tmp_path, work, OWED._replace(then="fail")).pump.cell
    assert (cell.state, cell.culprits) == (State.STOPPING, ("a",))
    assert cell.failure == "node a: no image within 4s of its start"


def test_a_frozen_node_cannot_speak(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.owing.held, bench.speaks = {"a"}, False
        await bench.work(60)

    assert not lived(tmp_path, work).named("node-silent")


def test_another_probe_after_one_that_ended(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.work(5)
        bench.populate(False)
        await bench.work(5)

    bench = lived(tmp_path, work)
    assert [one["id"] for one in bench.added()] == [extra_id(PROBE, 1), extra_id(PROBE, 2)]
    assert not bench.named("outputs-unwatched")


def test_probes_that_end_again_and_again(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.dora.then["AddNode"] = lambda: None
        bench.listens = False
        await bench.work(200)

    bench = lived(tmp_path, work)
    told = [("outputs-unwatched", "the probe ended again and again")]
    assert bench.named("outputs-unwatched", "node-silent") == told
    assert 6 <= len(bench.added()) <= 12


def test_a_probe_that_hangs_is_replaced(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        await bench.work(3)
        bench.listens = False
        (bench.group / "cgroup.kill").touch()
        await bench.work(35)

    bench = lived(tmp_path, work)
    assert bench.named("outputs-unwatched")[0][1] == "the probe does not respond"
    assert (bench.group / "cgroup.kill").read_text() == "1"


def test_no_probe_without_dora_rs(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        bench.python = ""
        await bench.work(100)

    bench = lived(tmp_path, work)
    assert bench.named("outputs-unwatched") == [("outputs-unwatched", "no Python here has dora-rs")]
    assert not bench.added()


def test_nodes_that_have_ended_owe_nothing(tmp_path: Path) -> None:
    async def work(bench: Bench) -> None:
        ended = NodeStatus("finished")
        bench.pump.push(life.NodeReloading(1, "a", ended))
        bench.pump.push(life.NodeRemoved(2, "a"))
        await bench.work(60)

    bench = lived(tmp_path, work)
    assert bench.added() == []
    assert not bench.named("node-silent", "outputs-unwatched")


def test_a_node_that_speaks_while_the_probe_is_replaced(tmp_path: Path) -> None:
    """One message in 1.9 s, and none of them is noted while there is no probe."""

    async def work(bench: Bench) -> None:
        for _ in range(10):
            await bench.work(0.2)
            bench.speaks = False
            await bench.work(1.8)
            bench.populate(False)
            bench.listens = False
            await bench.work(1.5)
            bench.listens = True
            await bench.work(1)
            bench.speaks = True
            await bench.work(40)

    bench = lived(tmp_path, work)
    assert len(bench.added()) == 11
    assert not bench.named("node-silent")
