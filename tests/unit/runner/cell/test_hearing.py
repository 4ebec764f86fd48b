"""What dora tells of the nodes, and what is done about it before it becomes an event."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.owes import PROBE, Owed
from dora_systemd.decisions.cell.rights import NodeRights
from dora_systemd.decisions.dora.protocol import LogRecord
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Do, State
from dora_systemd.decisions.resources.oom import Oom, Owner
from tests.unit.fakes.dialogue import OPTIONS, Bench
from tests.unit.fakes.loop import live
from tests.unit.fakes.manager import with_owes, with_rights
from tests.unit.fakes.run import Calls


def test_a_subscription_and_its_end(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        assert await bench.do(Do.SUBSCRIBE) == [life.Subscribed(0)]
        assert ("subscribe", "run") in bench.calls
        bench.dora.closed.set()
        await asyncio.sleep(1)
        assert bench.heard == [life.Subscribed(0), life.ConnectionLost(0)]

    live(work)


async def hear(bench: Bench, message: str, node: str = "a") -> Calls:
    """What is done about a line of dora's about a node."""
    await bench.do(Do.SUBSCRIBE)
    bench.calls.clear()
    bench.pump.heard.clear()
    assert bench.dora.hear is not None
    bench.dora.hear(LogRecord("INFO", "daemon", node, message))
    return bench.calls


EXITED = "handling node stop with exit status ExitCode(1) (restart: {}"


def test_a_node_that_was_executed(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, "spawned node with pid 8")
        assert done == [("adopt", "a", 8), ("push", "NodeSpawned")]

    live(work)


def test_what_a_crashed_node_has_left_goes_before_the_next_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, EXITED.format("true"))
        assert done == [("clear", "a", 7), ("push", "NodeExited"), ("forget", "a")]
        assert bench.heard == [life.NodeExited(0, "a", exit_of(1), True)]

    live(work)


def test_what_a_hung_node_has_left_is_killed_even_for_good(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        node = bench.pump.cell.nodes["a"]._replace(hung="no WATCHDOG=1 for 5s")
        bench.pump.cell = replace(bench.pump.cell, nodes={"a": node})
        done = await hear(bench, EXITED.format("false"))
        assert done == [("clear", "a", 7), ("push", "NodeExited"), ("forget", "a")]

    live(work)


def test_what_a_node_has_left_for_good_is_not_touched(tmp_path: Path) -> None:
    async def work() -> None:
        done = await hear(Bench(tmp_path), EXITED.format("false"))
        assert done == [("push", "NodeExited"), ("forget", "a")]

    live(work)


def test_the_end_of_a_node_that_has_been_replaced(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.nodes.living = {("a", 7)}
        assert await hear(bench, EXITED.format("true")) == [("push", "NodeExited")]
        assert bench.heard == [life.NodeExited(0, "a", exit_of(1), True, is_stale=True)]

    live(work)


def test_a_node_that_used_up_its_memory(tmp_path: Path) -> None:
    async def work() -> None:
        bench, oom = Bench(tmp_path), Oom(Owner.NODE, 1 << 30, 1 << 30)
        bench.nodes.ooms = {"a": oom}
        await hear(bench, EXITED.format("false"))
        assert bench.heard == [life.NodeExited(0, "a", Exit(words=oom.text), False, oom=oom)]

    live(work)


def test_a_line_that_means_nothing(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        assert await hear(bench, "hello") == []

    live(work)


OWES = (Owed("a", "image", 2_000_000),)
PROBE_NODE = f"{PROBE}a"


def test_a_node_that_the_runner_has_added_is_none_of_the_dataflow(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, options=with_owes(OPTIONS, *OWES))
        assert await hear(bench, EXITED.format("false"), PROBE_NODE) == []
        done = await hear(bench, EXITED.format("false"))
        assert done == [("push", "NodeExited"), ("forget", "a")]
        bench = Bench(tmp_path)
        done = await hear(bench, EXITED.format("false"), PROBE_NODE)
        assert done == [("push", "NodeExited"), ("forget", PROBE_NODE)], "it is called so"

    live(work)


def test_the_result_has_only_nodes_of_the_dataflow(tmp_path: Path) -> None:
    results = {"a": {"Ok": None}, PROBE_NODE: {"Ok": None}}
    ended = {"DataflowStopped": {"result": {"node_results": results}}}

    async def work() -> None:
        bench = Bench(tmp_path, State.CLOSING, options=with_owes(OPTIONS, *OWES))
        bench.dora.answers["Check"].append(ended)
        assert await bench.do(Do.ASK_RESULT) == [life.ResultKnown(0, {"a": Exit()})]

    live(work)


def test_a_node_gets_its_rights_when_it_is_executed(tmp_path: Path) -> None:
    rights = (NodeRights("a", nice=5),)

    async def work() -> None:
        bench = Bench(tmp_path, options=with_rights(OPTIONS, *rights))
        done = await hear(bench, "spawned node with pid 8")
        assert done == [("adopt", "a", 8, *rights), ("push", "NodeSpawned")]

    live(work)


@pytest.mark.parametrize("node", ["a", "b"])
def test_the_end_of_an_essential_node_says_so(tmp_path: Path, node: str) -> None:
    rights = (NodeRights("a", essential=True),)

    async def work() -> None:
        bench = Bench(tmp_path, options=with_rights(OPTIONS, *rights))
        await hear(bench, EXITED.format("false"), node)
        (event,) = bench.heard
        assert isinstance(event, life.NodeExited)
        assert event.is_essential == (node == "a")

    live(work)


def test_a_node_that_ends_well_has_nothing_to_clear(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, "handling node stop with exit status Success (restart: true")
        assert done == [("push", "NodeExited"), ("forget", "a")]
        assert bench.heard == [life.NodeExited(0, "a", Exit(), True)]

    live(work)


def test_what_is_said_of_a_node_that_is_not_in_the_table(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.nodes.living = {("new", 0)}
        done = await hear(bench, EXITED.format("true"), "new")
        assert done == [("push", "NodeExited"), ("forget", "new")]

    live(work)
