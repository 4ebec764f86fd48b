"""A stop with an order, carried out: what dora gets, the signals, and the time that is left."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import EndNode, GiveTime, State, StopNode
from dora_systemd.runner.cell.node_stops import NodeStops
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.dialogue import Bench
from tests.unit.fakes.loop import live, settle

LIMIT = 100 * SECOND


class Stopping(Bench):
    """A stop in progress; `at` is the time of its clock."""

    def __init__(self, root: Path, nodes: Sequence[str] = ("a",)) -> None:
        super().__init__(root, State.STOPPING)
        known = {node: NodeStatus("running", 7) for node in nodes}
        self.pump.cell = replace(self.pump.cell, stop_limit=LIMIT, nodes=known)
        self.at = 1000
        self.stops = NodeStops(self.pump, self.dora, self.nodes, self.dialogue, lambda: self.at)


def test_dora_sends_the_stop_and_kills_nobody(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Stopping(tmp_path)
        bench.stops.perform(StopNode("a", 10 * SECOND))
        await settle()
        never = {"secs": 200, "nanos": 0}
        asked = {"dataflow_id": "run", "node_id": "a", "grace_duration": never}
        assert bench.dora.asked == [{"StopNode": asked}]
        assert ("let go",) in bench.calls, "a frozen node cannot stop"
        assert bench.nodes.stop_dues == {"a": 1000 + 10 * SECOND}

    live(work)


def test_the_time_of_each_node_ends_on_its_own(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Stopping(tmp_path, ("a", "b"))
        bench.stops.perform(StopNode("a", 1))
        bench.stops.perform(StopNode("b", 50 * SECOND))
        await asyncio.sleep(1)
        assert life.NodeOverdue(0, "a") in bench.heard
        assert life.NodeOverdue(0, "b") not in bench.heard

    live(work)


def test_more_time_never_makes_it_shorter(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Stopping(tmp_path)
        bench.stops.perform(StopNode("a", 10 * SECOND))
        bench.stops.perform(GiveTime("a", 5 * SECOND))
        assert bench.nodes.stop_dues == {"a": 1000 + 10 * SECOND}
        bench.stops.perform(GiveTime("a", 20 * SECOND))
        assert bench.nodes.stop_dues == {"a": 1000 + 20 * SECOND}

    live(work)


def test_an_infinite_time_is_not_shown(tmp_path: Path) -> None:
    """The table that `list` reads has no such numbers: it would refuse the whole table."""

    async def work() -> None:
        bench = Stopping(tmp_path)
        bench.stops.perform(StopNode("a", 10 * SECOND))
        bench.stops.perform(GiveTime("a", INFINITY - SECOND))
        assert bench.nodes.stop_dues == {}
        bench.stops.perform(EndNode("a", 5 * SECOND))
        assert bench.nodes.stop_dues == {"a": 1000 + 5 * SECOND}

    live(work)


def test_what_ends_a_node_that_is_late(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Stopping(tmp_path)
        group = tmp_path / "node-a"
        group.mkdir()
        for name in ("cgroup.kill", "cgroup.procs"):
            (group / name).touch()
        bench.stops.perform(StopNode("a", SECOND))
        bench.stops.perform(EndNode("a", 5 * SECOND))
        assert bench.nodes.stop_dues == {"a": 1000 + 5 * SECOND}
        assert (group / "cgroup.kill").read_text() == ""
        bench.stops.perform(EndNode("a"))
        assert (group / "cgroup.kill").read_text() == "1"
        assert bench.nodes.stop_dues == {}

    live(work)


def test_an_extension_counts_from_the_beginning_of_the_stop(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Stopping(tmp_path)
        bench.stops.extend("a", SECOND)
        assert bench.heard == [], "the stop has not begun"
        bench.stops.perform(StopNode("a", 10 * SECOND))
        bench.at += 3 * SECOND
        bench.stops.extend("a", SECOND)
        assert bench.heard == [life.NodeExtends(0, "a", SECOND, 3 * SECOND)]
        bench.enter(State.LEAVING)
        bench.stops.extend("a", SECOND)
        assert len(bench.heard) == 1

    live(work)
