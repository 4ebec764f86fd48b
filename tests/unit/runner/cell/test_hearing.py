"""What dora tells of the nodes, and what is done about it before it becomes an event."""

import asyncio
import os
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.exits import Exit, ExitKind, exit_of
from dora_systemd.decisions.cell.extra import PROBE, extra_id
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.rights import NodeRights
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora.protocol import LogRecord
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Do, State
from dora_systemd.decisions.resources.oom import Oom, Owner
from dora_systemd.runner.cell.pump import Pump
from tests.unit.fakes.dialogue import OPTIONS, Bench, Heard
from tests.unit.fakes.loop import live, settle
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


@pytest.mark.parametrize("is_alive", [True, False])
def test_a_run_that_dora_has_forgotten_for_a_while(tmp_path: Path, is_alive: bool) -> None:
    """After a freeze the daemon connects again. It does not repeat earlier reports."""

    async def work() -> None:
        bench = Bench(tmp_path)
        bench.nodes.living = {("a", 7)} if is_alive else set()
        await bench.do(Do.SUBSCRIBE)
        bench.dora.unsubscribes, bench.dora.forgets = 1, 3
        bench.dora.closed.set()
        await asyncio.sleep(2)
        assert bench.calls.count(("subscribe", "run")) == 5
        await asyncio.sleep(2)
        reason = "the dora daemon was not connected when a node ended: a"
        lost = [] if is_alive else [life.ConnectionLost(0, reason=reason)]
        assert bench.heard == [life.Subscribed(0), *lost]

    live(work)


def test_an_end_that_dora_reports_late_is_not_lost(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        await bench.do(Do.SUBSCRIBE)
        bench.dora.unsubscribes = 1
        bench.dora.closed.set()
        await asyncio.sleep(1)
        bench.pump.cell = replace(bench.pump.cell, nodes={"a": NodeStatus("failed")})
        await asyncio.sleep(3)
        assert bench.heard == [life.Subscribed(0)]

    live(work)


async def hear(bench: Bench, *messages: str, node: str = "a") -> Calls:
    """What is done about lines of dora's about a node."""
    await bench.do(Do.SUBSCRIBE)
    bench.calls.clear()
    bench.pump.heard.clear()
    assert bench.dora.hear is not None
    for message in messages:
        bench.dora.hear(LogRecord("INFO", "daemon", node, message))
    return bench.calls


STOPPED = "handling node stop with exit status {} (restart: {}"
EXITED = STOPPED.format("ExitCode(1)", "{}")
NEXT = "exited with code 1"
"""What dora prints next of a node that has exited."""


class Taking(Heard):
    """A pump that takes the events through the table."""

    push = Pump.push


REPLACED = "ignoring stale exit from pid {} (generation 2); `a` has been removed or replaced"


def test_a_node_that_was_executed(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, "spawned node with pid 8")
        assert done == [("adopt", "a", 8), ("push", "NodeSpawned")]

    live(work)


def test_what_a_crashed_node_has_left_goes_before_the_next_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, EXITED.format("true"), NEXT)
        assert done == [("clear", "a", 7), ("push", "NodeExited"), ("forget", "a")]
        assert bench.heard == [life.NodeExited(0, "a", exit_of(1), True)]

    live(work)


HANGS = "unresponsive for 5322ms (timeout: 5s)"


def test_the_daemon_says_why_it_killed_a_node_before_the_exit(tmp_path: Path) -> None:
    """Its line and dora's records take two ways, and the runner may find both at once."""

    async def work() -> None:
        bench = Bench(tmp_path, kind=Taking)
        reader, writer = os.pipe()
        LogPipes.add_output(bench.pipes, "daemon", reader, bench.dialogue._read_daemon)
        await bench.do(Do.SUBSCRIBE)
        assert bench.dora.hear is not None
        os.write(writer, f" WARN dora_daemon: node `a` {HANGS}, killing\n".encode())
        for message in (STOPPED.format("Signal(9)", "true)"), NEXT, "spawned node with pid 8"):
            bench.dora.hear(LogRecord("INFO", "daemon", "a", message))
        await settle()
        node = bench.pump.cell.nodes["a"]
        assert (node.exit, node.hung) == (Exit(ExitKind.HUNG, words=HANGS), "")
        assert (node.state, node.pid) == ("starting", 8)
        os.close(writer)
        await settle()

    live(work)


def test_what_a_hung_node_has_left_is_killed_even_for_good(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        node = bench.pump.cell.nodes["a"]._replace(hung="no WATCHDOG=1 for 5s")
        bench.pump.cell = replace(bench.pump.cell, nodes={"a": node})
        done = await hear(bench, EXITED.format("false"), NEXT)
        assert done == [("clear", "a", 7), ("push", "NodeExited"), ("forget", "a")]

    live(work)


def test_what_a_node_has_left_for_good_is_not_touched(tmp_path: Path) -> None:
    async def work() -> None:
        done = await hear(Bench(tmp_path), EXITED.format("false"), NEXT)
        assert done == [("push", "NodeExited"), ("forget", "a")]

    live(work)


def test_the_end_of_a_node_that_has_been_replaced(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.nodes.living = {("a", 7)}
        assert await hear(bench, EXITED.format("true"), NEXT) == [("push", "NodeExited")]
        assert bench.heard == [life.NodeExited(0, "a", exit_of(1), True, is_stale=True)]

    live(work)


WAITING = "waiting 500ms before restart (attempt 1)"
"""Dora prints this before the exit of that process."""
KILLED, FAILED = STOPPED.format("Signal(15)", "false"), EXITED.format("false")
LATE: list[tuple[str, list[str]]] = [
    ("the replaced process ends first", [KILLED, REPLACED.format(7), FAILED, NEXT]),
    ("the next process ends first", [FAILED, NEXT, KILLED, REPLACED.format(7)]),
    ("both end at once", [KILLED, WAITING, REPLACED.format(7), FAILED, NEXT]),
    ("dora reports nothing else", [KILLED, REPLACED.format(7), FAILED]),
    ("it failed by itself", [EXITED.format("true"), REPLACED.format(7), FAILED, NEXT]),
    (
        "dora cancels its restart, and reports its exit again",
        [FAILED, NEXT, KILLED, REPLACED.format(7), KILLED, REPLACED.format(7)],
    ),
]


@pytest.mark.parametrize("lines", [lines for _, lines in LATE], ids=[name for name, _ in LATE])
@pytest.mark.parametrize("policy", ["never", "on-failure"])
def test_the_cause_is_that_of_the_process_that_failed(
    tmp_path: Path, lines: list[str], policy: str
) -> None:
    """A runner that is slow learns of both exits when no process of the node is left."""

    async def work() -> None:
        bench = Bench(tmp_path, kind=Taking)
        bench.pump.cell = replace(
            bench.pump.cell, nodes={"a": NodeStatus("running", 7, 1, policy=policy)}
        )
        again = [line.replace(FAILED, EXITED.format("true")) for line in lines]
        await hear(
            bench,
            "spawned node with pid 8",
            "node is ready",
            *(lines if policy == "never" else again),
        )
        await asyncio.sleep(2)
        node = bench.pump.cell.nodes["a"]
        state = "failed" if policy == "never" else "restarting"
        assert (node.state, node.exit, node.restarts) == (state, exit_of(1), 1)
        crashes = [details for name, _, details in bench.pipes.events if name == "node-crashed"]
        assert crashes == [{"exit": "exit code 1"}]

    live(work)


@pytest.mark.parametrize("state", ["waiting", "reloading", "running"])
def test_dora_ends_the_newer_process_and_keeps_the_earlier_one(tmp_path: Path, state: str) -> None:
    """ReplaceNode and a restart after its delay, on a slow machine: each starts a process."""

    async def work() -> None:
        bench = Bench(tmp_path, kind=Taking)
        bench.pump.cell = replace(bench.pump.cell, nodes={"a": NodeStatus(state, 0, 1)})
        bench.nodes.living = {("a", 8)}
        spawned = "spawned node with pid {}"
        ready = [] if state == "waiting" else ["node is ready"]
        await hear(bench, spawned.format(8), spawned.format(9), *ready)
        before = bench.pump.cell.nodes["a"]
        await hear(bench, KILLED, REPLACED.format(9))
        await asyncio.sleep(2)
        assert before.pid == 9
        assert bench.pump.cell.nodes["a"] == before._replace(pid=8)
        assert not [name for name, *_ in bench.pipes.events if name == "node-crashed"]

    live(work)


def test_the_end_of_a_node_that_is_removed(tmp_path: Path) -> None:
    """Dora reports it like that of a replaced one, but no other process follows."""

    async def work() -> None:
        bench = Bench(tmp_path)
        await hear(bench, KILLED, REPLACED.format(7))
        assert bench.heard == [life.NodeExited(0, "a", exit_of(-15), False)]

    live(work)


def test_the_memory_that_a_replaced_process_did_not_use_up(tmp_path: Path) -> None:
    """The kernel has killed the next process."""

    async def work() -> None:
        bench, oom = Bench(tmp_path), Oom(Owner.NODE, 1 << 30, 1 << 30)
        bench.nodes.ooms = {"a": oom}
        await hear(bench, KILLED, REPLACED.format(6))
        assert bench.heard == [life.NodeExited(0, "a", exit_of(-15), False, is_stale=True)]
        assert not {call[0] for call in bench.calls} & {"clear", "forget"}

    live(work)


def test_a_stop_does_not_wait_for_what_dora_reports_next(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.STOPPING)
        assert ("push", "NodeExited") in await hear(bench, KILLED)

    live(work)


def test_a_node_that_used_up_its_memory(tmp_path: Path) -> None:
    async def work() -> None:
        bench, oom = Bench(tmp_path), Oom(Owner.NODE, 1 << 30, 1 << 30)
        bench.nodes.ooms = {"a": oom}
        await hear(bench, EXITED.format("false"), NEXT)
        assert bench.heard == [life.NodeExited(0, "a", Exit(words=oom.text), False, oom=oom)]

    live(work)


def test_a_line_that_means_nothing(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        assert await hear(bench, "hello") == []

    live(work)


OWES = (Owed("a", "image", 2_000_000),)
PROBE_NODE = extra_id(PROBE, 1)


def test_a_node_that_the_runner_has_added_is_none_of_the_dataflow(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, options=with_owes(OPTIONS, *OWES))
        assert await hear(bench, EXITED.format("false"), NEXT, node=PROBE_NODE) == []
        done = await hear(bench, EXITED.format("false"), NEXT)
        assert done == [("push", "NodeExited"), ("forget", "a")]
        bench = Bench(tmp_path)
        done = await hear(bench, EXITED.format("false"), NEXT, node=PROBE_NODE)
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
        await hear(bench, EXITED.format("false"), NEXT, node=node)
        (event,) = bench.heard
        assert isinstance(event, life.NodeExited)
        assert event.is_essential == (node == "a")

    live(work)


def test_a_node_that_ends_well_has_nothing_to_clear(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        done = await hear(bench, STOPPED.format("Success", "true"), "a finished successfully")
        assert done == [("push", "NodeExited"), ("forget", "a")]
        assert bench.heard == [life.NodeExited(0, "a", Exit(), True)]

    live(work)


def test_what_is_said_of_a_node_that_is_not_in_the_table(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.nodes.living = {("new", 0)}
        done = await hear(bench, EXITED.format("true"), NEXT, node="new")
        assert done == [("push", "NodeExited"), ("forget", "new")]

    live(work)
