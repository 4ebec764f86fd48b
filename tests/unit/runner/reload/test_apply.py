"""One reload of single nodes: its steps, what dora is asked in which order, and the way back."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.decisions.cell.options import parse_setting
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.reload.changes import How
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.reload.swap import NotReady
from dora_systemd.values import SECOND
from tests.unit.fakes.loop import live
from tests.unit.fakes.manager import with_owes
from tests.unit.fakes.reload import EXCHANGES, RUNNING
from tests.unit.fakes.reload import ReloadBench as Bench

STEPS = [
    (How.SWAP, "a", [("RemoveNode", "a"), ("AddNode", "a")]),
    (How.REWIRE, "a", [("RemoveNode", "a"), ("AddNode", "a")]),
    (How.REMOVE, "a", [("RemoveNode", "a")]),
    (How.ADD, "c", [("AddNode", "c")]),
]


@pytest.mark.parametrize(("how", "node", "asked"), STEPS)
def test_what_dora_is_asked_for_a_step(
    tmp_path: Path, how: How, node: str, asked: list[Any]
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        await bench.applier((how, node)).apply()
        assert bench.asked == asked
        assert (node in bench.states()) is (how is not How.REMOVE)
        assert bench.pipes.events[-1][0] == "node-reloaded"

    live(work)


def test_one_step_follows_the_other(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        applier = bench.applier((How.REMOVE, "a"), (How.SWAP, "b"), (How.ADD, "c"))
        await applier.apply()
        assert [node for _, node in bench.asked] == ["a", "b", "b", "c"]
        marks = [call for call in bench.calls if call[0] in ("begin", "end")]
        assert marks == [(mark, node) for node in "abc" for mark in ("begin", "end")]
        assert applier.done[0] == "the node a was removed: a.py"
        assert applier.done[1].startswith("the node b was reloaded: b.py, ready after ")

    live(work)


def test_a_new_node_has_its_room_before_dora_starts_it(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        await bench.applier((How.ADD, "c")).apply()
        room, ask = bench.calls.index(("make room", "c")), ("ask", "AddNode", "c")
        assert room < bench.calls.index(ask)

    live(work)


def test_the_room_of_a_node_goes_when_it_has_ended(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.then["RemoveNode"] = lambda: asyncio.get_running_loop().call_later(1, bench.end)
        await bench.applier((How.REMOVE, "a")).apply()
        room = bench.calls.index(("take room", "a"))
        assert room > bench.calls.index(("drain", "a")), "its last words were read"

    live(work)


@pytest.mark.parametrize(("is_read", "old", "methods"), EXCHANGES)
def test_a_node_is_replaced_as_by_hand(
    tmp_path: Path, is_read: bool, old: NodeStatus, methods: list[str]
) -> None:
    """See test_asked.py for a restart by hand."""

    async def work() -> None:
        bench = Bench(tmp_path, a=old)
        bench.prepared = bench.write("ab", reader="b" if is_read else "")
        await bench.applier((How.SWAP, "a")).apply()
        assert bench.asked == [(method, "a") for method in methods]

    live(work)


@pytest.mark.parametrize(
    ("old", "options"),
    [
        (RUNNING, {"settings": (parse_setting("a:replace=start-first"),)}),
        (
            RUNNING._replace(policy="never"),
            {"settings": (parse_setting("replace=start-first"),)},
        ),
        (RUNNING._replace(state="waiting", needs="/dev/cam"), {}),
    ],
    ids=["start first", "start first without restarts", "it waits"],
)
def test_the_old_process_is_not_ended_first(
    tmp_path: Path, old: NodeStatus, options: dict[str, Any]
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, a=old)
        bench.options = bench.options._replace(**options)
        await bench.applier((How.SWAP, "a")).apply()
        assert bench.asked == [("ReplaceNode", "a")]

    live(work)


def test_a_node_that_owes_an_output_is_not_removed(tmp_path: Path) -> None:
    """The watch over this output reads it, and would hear nothing any more."""

    async def work() -> None:
        bench = Bench(tmp_path)
        bench.options = with_owes(bench.options, Owed("a", "o", SECOND, SECOND, "warn"))
        await bench.applier((How.SWAP, "a")).apply()
        assert bench.asked == [("RestartNode", "a"), ("ReplaceNode", "a")]

    live(work)


@pytest.mark.parametrize("reader", ["", "b"])
def test_the_way_back_does_not_remove_what_the_new_version_reads(
    tmp_path: Path, reader: str
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        before = bench.prepared
        bench.prepared = bench.write("ab", reader)
        applier = bench.applier((How.SWAP, "a"))
        await applier.apply()
        bench.calls.clear()
        await applier.undo(before)
        assert ("RemoveNode", "a") not in bench.asked or not reader
        assert bench.asked[-1] == ("ReplaceNode" if reader else "AddNode", "a")

    live(work)


def test_a_process_that_dora_is_just_starting_is_known_before_it_is_ended(tmp_path: Path) -> None:
    """As after a restart by hand, which does not wait for it."""

    async def work() -> None:
        bench = Bench(tmp_path, a=RUNNING._replace(state="starting", pid=0))
        task = asyncio.create_task(bench.applier((How.SWAP, "a")).apply())
        await asyncio.sleep(1)
        assert not bench.asked
        bench.pump.push(life.NodeSpawned(1, "a", 6))
        await task
        assert bench.asked == [("RemoveNode", "a"), ("AddNode", "a")]

    live(work)


def test_an_operator_reads_its_file_again(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        files = {"a": {"one": f"{tmp_path}/a.py", "two": "/other.py"}}
        await bench.applier((How.OPERATOR, "a"), operators=files).apply()
        assert bench.dora.asked == [
            {"Reload": {"dataflow_id": "run", "node_id": "a", "operator_id": "one"}}
        ]

    live(work)


@pytest.mark.parametrize(
    ("then", "words"),
    [("crash", "node a: exit code 1"), ("wait", "node a: not ready within 30s")],
)
def test_a_node_that_does_not_get_ready(tmp_path: Path, then: str, words: str) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.then["AddNode"] = bench.crash if then == "crash" else lambda: None
        applier = bench.applier((How.SWAP, "a"), (How.SWAP, "b"))
        began = asyncio.get_running_loop().time()
        with pytest.raises(NotReady) as caught:
            await applier.apply()
        assert str(caught.value) == words
        assert applier.done == []
        assert "b" not in {node for _, node in bench.asked}, "nothing follows"
        waited = asyncio.get_running_loop().time() - began
        assert round(waited) == (0 if then == "crash" else 30)

    live(work)


@pytest.mark.parametrize(
    ("start", "seconds"), [(-50, 30), (0.5, 30), (7, 30), (20, 80), (3600, 600)]
)
def test_a_slow_start_gives_a_new_version_more_time(
    tmp_path: Path, start: float, seconds: int
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.pump.cell = replace(bench.pump.cell, ready_us=round(start * SECOND))
        bench.dora.then["AddNode"] = lambda: None
        began = asyncio.get_running_loop().time()
        with pytest.raises(NotReady):
            await bench.applier((How.SWAP, "a")).apply()
        assert round(asyncio.get_running_loop().time() - began) == seconds

    live(work)


def test_what_dora_refuses_is_told(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.dora.refuses = {"AddNode": "no room\n\nLocation: x"}
        with pytest.raises(DoraSystemdError, match=r"^cannot do that in dora: no room$"):
            await bench.applier((How.ADD, "c")).apply()

    live(work)


def test_the_way_back_begins_with_the_last_step(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        applier = bench.applier((How.REMOVE, "a"), (How.SWAP, "b"), (How.ADD, "c"))
        bench.dora.then["AddNode"] = lambda: bench.crash() if bench.node == "c" else bench.spawn()
        with pytest.raises(NotReady):
            await applier.apply()
        bench.calls.clear()
        bench.dora.then["AddNode"] = bench.spawn
        await applier.undo(bench.prepared)
        assert bench.asked == [
            ("RemoveNode", "c"),
            *(("RemoveNode", "b"), ("AddNode", "b")),
            ("AddNode", "a"),
        ]
        assert bench.states() == {"a": "running", "b": "running"}

    live(work)


def test_the_way_back_goes_on_over_a_node_that_is_not_ready(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        applier = bench.applier((How.REMOVE, "a"), (How.SWAP, "b"))
        bench.dora.then["AddNode"] = bench.crash
        with pytest.raises(NotReady):
            await applier.apply()
        await applier.undo(bench.prepared)
        assert bench.asked[-1] == ("AddNode", "a")

    live(work)


@pytest.mark.parametrize(
    ("state", "old", "reason"),
    [
        (State.RUNNING, RUNNING, ""),
        (State.WAITING, RUNNING, "not all nodes were ready"),
        (State.RUNNING, NodeStatus("finished"), "the node a had ended"),
        (State.RUNNING, NodeStatus("failed"), "the node a had ended"),
        (State.RUNNING, NodeStatus("failed", policy=HELD), ""),
    ],
)
def test_what_dora_cannot_change_now(
    tmp_path: Path, state: State, old: NodeStatus, reason: str
) -> None:
    async def work() -> None:
        assert Bench(tmp_path, state, a=old).applier((How.SWAP, "a")).obstacle() == reason

    live(work)


def test_the_descriptor_that_is_sent_is_the_new_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        await bench.applier((How.SWAP, "a")).apply()
        assert _sent(bench) == _definition(bench.prepared, "a")

    live(work)


def _sent(bench: Bench) -> Any:
    params = bench.dora.asked[-1]
    assert not isinstance(params, str)
    return params["AddNode"]["node"]


def _definition(prepared: Prepared, node: str) -> Any:
    return next(one for one in prepared.descriptor["nodes"] if one["id"] == node)
