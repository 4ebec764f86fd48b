"""A stop with an order on the head: what members are told, and when."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State, StopNode
from dora_systemd.decisions.machines import wire
from dora_systemd.runner.machines.order import SpreadStops
from dora_systemd.values import SECOND
from tests.unit.fakes.ends import FakeEnds
from tests.unit.fakes.loop import live, settle
from tests.unit.runner.machines.test_head import READY, Bench

NODES = {
    "arm": NodeStatus("running", 7),
    "camera": NodeStatus("running", machine="gpu"),
    "recorder": NodeStatus("running", 8),
    "upload": NodeStatus("running", machine="gpu"),
}
STOPS = {
    "recorder": NodeStop("recorder", 60 * SECOND, ("camera",)),
    "upload": NodeStop("upload", 20 * SECOND, ("camera",)),
}
LIMIT = 100 * SECOND


class Stopping(Bench):
    """A stop that has just begun, on the head and its member gpu."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        changes = {"stops": STOPS, "stop_limit": LIMIT, "stop_by": "SIGTERM", "ready_us": 1}
        self.be(State.STOPPING, nodes=NODES, **changes)
        given = self.pump, self.dora, self.nodes, self.dialogue, self.roster
        self.stops = SpreadStops(*given)

    def stopped(self) -> list[str]:
        """The nodes that dora was requested to stop."""
        asked: list[Any] = self.dora.asked
        return [one["StopNode"]["node_id"] for one in asked]


def run(root: Path, work: Callable[[Stopping, FakeEnds], Coroutine[Any, Any, None]]) -> None:
    async def on_loop() -> None:
        bench = Stopping(root)
        try:
            other = await bench.link(READY)
            other.writer.data = b""
            await work(bench, other)
        finally:
            bench.dialogue.cancel()

    live(on_loop)


STOPPING = {"type": "stopping", "by": "SIGTERM", "limit": LIMIT}


def test_each_machine_stops_its_own_nodes(tmp_path: Path) -> None:
    async def work(bench: Stopping, other: FakeEnds) -> None:
        bench.stops.perform(StopNode("arm", 10 * SECOND))
        bench.stops.perform(StopNode("camera", 10 * SECOND))
        await settle()
        assert bench.stopped() == ["arm"]
        first, second = other.heard()
        assert first == STOPPING
        assert (second["type"], second["node"], second["within"]) == (
            *("stop-node", "camera"),
            10 * SECOND,
        )
        # What comes after it has a minute, and half a grace duration twice.
        assert 35 * SECOND < second["most"] <= 38 * SECOND
        assert [*bench.nodes.stop_dues] == ["arm"]

    run(tmp_path, work)


def test_the_last_messages_of_another_machine_may_still_be_on_their_way(tmp_path: Path) -> None:
    async def work(bench: Stopping, other: FakeEnds) -> None:
        bench.stops.perform(StopNode("upload", 20 * SECOND))
        assert other.heard()[1]["node"] == "upload", "the camera is there, too"
        bench.stops.perform(StopNode("recorder", 60 * SECOND))
        await settle()
        assert bench.dora.asked == []
        await asyncio.sleep(1)
        assert bench.stopped() == ["recorder"]

    run(tmp_path, work)


def test_a_stop_that_is_over_meanwhile(tmp_path: Path) -> None:
    async def work(bench: Stopping, other: FakeEnds) -> None:
        bench.stops.perform(StopNode("recorder", 60 * SECOND))
        bench.be(State.LEAVING)
        await asyncio.sleep(1)
        assert bench.dora.asked == []
        assert other.heard() == [STOPPING, {"type": "stopping", "by": "SIGTERM", "limit": 0}]

    run(tmp_path, work)


def test_a_machine_that_is_slow_is_not_lost_before_the_lease_ends(tmp_path: Path) -> None:
    """The loss would be SIGTERM for its recorder, which then saves nothing."""

    async def work(bench: Stopping, other: FakeEnds) -> None:
        bench.stops.perform(StopNode("camera", 10 * SECOND))
        await asyncio.sleep(6)
        assert not bench.heard(life.MachineLost)
        other.say(wire.Beat())
        await asyncio.sleep(6)
        assert not bench.heard(life.MachineLost)
        await asyncio.sleep(2)
        assert bench.heard(life.MachineLost)[0] == life.MachineLost(0, "gpu", "no word for 7s")

    run(tmp_path, work)


def test_a_machine_that_is_gone_while_it_waits_for_its_turn(tmp_path: Path) -> None:
    """It has reported its end, so the end of its connection is no other event."""

    async def work(bench: Stopping, other: FakeEnds) -> None:
        bench.stops.perform(StopNode("camera", 10 * SECOND))
        other.say(wire.Ended(by="root", waits=1))
        await asyncio.sleep(1)
        gone = life.MachineLost(0, "gpu", "it does not answer")
        assert gone not in bench.heard(life.MachineLost)
        other.reader.feed_eof()
        await asyncio.sleep(1)
        assert gone in bench.heard(life.MachineLost)

    run(tmp_path, work)
