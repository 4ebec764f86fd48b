"""What each event leaves in the live table of a node, and what the journal is told of it."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import Exit, ExitKind, exit_of
from dora_systemd.decisions.cell.restarts import HELD_SECONDS, LATCH_SECONDS
from dora_systemd.decisions.cell.status import HELD, LATCHED, RESTART, STOP, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause, result_words
from dora_systemd.decisions.life.failures import ENGINE_TIMEOUT
from dora_systemd.decisions.life.handlers import CASCADE_TIMEOUT
from dora_systemd.decisions.life.node_table import (
    all_ready,
    apply_results,
    is_over_but_for_held,
    spent,
    update,
)
from dora_systemd.decisions.life.refusal import setup_failure
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Deadline, Do, Record, State
from dora_systemd.decisions.life.stop_budget import LEAVE_TIMEOUT, stop_timeout
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import cell_status, format_status, initial_nodes, is_up
from dora_systemd.decisions.resources.oom import Oom, Owner
from dora_systemd.values import INFINITY, SECOND

RUNS = NodeStatus("running", 7, 1, 10, kind="python", policy="on-failure", max_restarts=3)
BY = "root (doractl node stop)"
CRASH = exit_of(1)
STOPPED = RUNS._replace(state="stopped", since_us=5, asked=STOP, asked_by=BY)
RELOADS = RUNS._replace(state="reloading")
WAITS = RUNS._replace(state="waiting", needs="/dev/x")
SILENT = RUNS._replace(silent="no image for 2s", is_ended=True)


def crashed(details: dict[str, str] | None = None, event: str = "node-crashed") -> Record:
    return Record(event, "a", {"exit": "exit code 1"} if details is None else details)


def exited(exit: Exit = CRASH, again: bool = False, is_stale: bool = False) -> life.NodeExited:
    return life.NodeExited(20, "a", exit, again, is_stale)


RESTARTED = Record("node-restarted", "a", {"restarts": "2"})
CASES: dict[str, tuple[NodeStatus, life.Event, NodeStatus, tuple[Record, ...]]] = {
    "executed": (
        RUNS,
        life.NodeSpawned(20, "a", 8),
        RUNS._replace(state="starting", pid=8, since_us=20),
        (),
    ),
    "executed again": (
        RUNS._replace(state="restarting", pid=0),
        life.NodeSpawned(20, "a", 8),
        RUNS._replace(state="starting", pid=8, since_us=20, restarts=2),
        (RESTARTED,),
    ),
    "a waiting one is executed": (
        WAITS,
        life.NodeSpawned(20, "a", 8),
        WAITS._replace(pid=8),
        (),
    ),
    "the launcher of a stopped one": (
        STOPPED,
        life.NodeSpawned(20, "a", 8),
        STOPPED._replace(pid=8, is_held=True),
        (),
    ),
    "ready": (
        RUNS._replace(state="starting", asked=RESTART, asked_by=BY, exit=CRASH),
        life.NodeReady(20, "a"),
        RUNS._replace(since_us=20),
        (Record("node-ready", "a"),),
    ),
    "ready, and stopped meanwhile": (
        STOPPED,
        life.NodeReady(20, "a"),
        STOPPED,
        (Record("node-ready", "a"),),
    ),
    "crashed": (
        RUNS._replace(hung="", silent="x"),
        exited(),
        RUNS._replace(state="failed", pid=0, since_us=20, exit=CRASH),
        (crashed(),),
    ),
    "crashed, and to be restarted": (
        RUNS,
        exited(again=True),
        RUNS._replace(state="restarting", pid=0, since_us=20, exit=CRASH),
        (crashed(),),
    ),
    "finished": (
        RUNS,
        exited(Exit()),
        RUNS._replace(state="finished", pid=0, since_us=20),
        (Record("node-exited", "a"),),
    ),
    "hung": (
        RUNS,
        life.NodeHung(20, "a", "unresponsive", "node-watchdog", {"limit": "5s"}),
        RUNS._replace(hung="unresponsive"),
        (Record("node-watchdog", "a", {"reason": "unresponsive", "limit": "5s"}),),
    ),
    "found to hang by dora": (
        RUNS,
        life.NodeHung(20, "a", "unresponsive"),
        RUNS._replace(hung="unresponsive"),
        (Record("node-hung", "a", {"reason": "unresponsive"}),),
    ),
    **{
        f"found to hang by dora, but {state} by now": (
            RUNS._replace(state=state, pid=pid),
            life.NodeHung(20, "a", "unresponsive"),
            RUNS._replace(state=state, pid=pid),
            (Record("node-hung", "a", {"reason": "unresponsive"}),),
        )
        for state, pid in (("restarting", 0), ("starting", 8), ("reloading", 7), ("failed", 0))
    },
    **{
        f"missed its watchdog, but {what}": (
            RUNS._replace(state=state, pid=0),
            life.NodeHung(20, "a", "unresponsive", "node-watchdog", is_late=is_late),
            RUNS._replace(state=state, pid=0),
            (Record("node-watchdog", "a", {"reason": "unresponsive"}),),
        )
        for what, state, is_late in (
            ("the next process runs by now", "running", True),
            ("its end is known", "restarting", False),
            ("has failed by now", "failed", False),
        )
    },
    "the end of a hung one": (
        RUNS._replace(hung="unresponsive"),
        exited(exit_of(-9)),
        RUNS._replace(
            state="failed", pid=0, since_us=20, exit=Exit(ExitKind.HUNG, words="unresponsive")
        ),
        (crashed({"exit": "hung, unresponsive"}, "node-ended"),),
    ),
    "a hung one that ends well": (
        RUNS._replace(hung="unresponsive"),
        exited(Exit()),
        RUNS._replace(state="finished", pid=0, since_us=20),
        (Record("node-exited", "a"),),
    ),
    "the end of a silent one": (
        SILENT,
        exited(Exit(), again=True),
        RUNS._replace(
            state="restarting", pid=0, since_us=20,
            exit=Exit(ExitKind.SILENT, words="no image for 2s"),
        ),
        (crashed({"exit": "silent, no image for 2s"}, "node-ended"),),
    ),
    "silent": (
        RUNS,
        life.NodeSilent(20, "a", "image", "no image for 2s", "warn", "no image for 2s"),
        RUNS._replace(silent="no image for 2s"),
        (
            Record(
                *("node-silent", "a"),
                {"output": "image", "reason": "no image for 2s", "then": "warn"},
            ),
        ),
    ),
    "silent, and to be restarted": (
        RUNS,
        life.NodeSilent(20, "a", "image", "r", "restart", "no image for 2s"),
        SILENT,
        (Record("node-silent", "a", {"output": "image", "reason": "r", "then": "restart"}),),
    ),
    "speaks again": (
        SILENT._replace(is_ended=False),
        life.NodeSpeaks(20, "a", "image", "image again after 3s", "no line for 2s"),
        RUNS._replace(silent="no line for 2s"),
        (
            Record(
                *("node-speaks-again", "a"),
                {"output": "image", "reason": "image again after 3s"},
            ),
        ),
    ),
    "a stop is asked for": (
        RUNS._replace(hung="x", silent="y", machine="gpu"),
        life.NodeAsked(20, "a", STOP, BY),
        STOPPED._replace(since_us=20, machine="gpu"),
        (Record("node-asked", "a", {"asked": STOP, "by": BY}),),
    ),
    "a stop of a waiting one is asked for": (
        WAITS,
        life.NodeAsked(20, "a", STOP, BY),
        STOPPED._replace(since_us=20, is_held=True),
        (Record("node-asked", "a", {"asked": STOP, "by": BY}),),
    ),
    "a restart is asked for": (
        RUNS._replace(machine="gpu"),
        life.NodeAsked(20, "a", RESTART, BY),
        RELOADS._replace(
            since_us=20, restarts=0, asked=RESTART, asked_by=BY, machine="gpu"
        ),
        (Record("node-asked", "a", {"asked": RESTART, "by": BY}),),
    ),
    "a restart of one that its watchdog ends is asked for": (
        RUNS._replace(hung="no WATCHDOG=1 for 5s"),
        life.NodeAsked(20, "a", RESTART, BY),
        RELOADS._replace(since_us=20, restarts=0, asked=RESTART, asked_by=BY),
        (Record("node-asked", "a", {"asked": RESTART, "by": BY}),),
    ),
    "a restart with another status is asked for": (
        RUNS,
        life.NodeAsked(20, "a", RESTART, BY, NodeStatus(kind="uv")),
        NodeStatus("reloading", 7, 0, 20, kind="uv", asked=RESTART, asked_by=BY),
        (Record("node-asked", "a", {"asked": RESTART, "by": BY}),),
    ),
    "a restart of a stopped one is asked for": (
        STOPPED,
        life.NodeAsked(20, "a", RESTART, BY),
        RUNS._replace(state="starting", since_us=20, restarts=0, asked=RESTART, asked_by=BY),
        (Record("node-asked", "a", {"asked": RESTART, "by": BY}),),
    ),
    "a restart of a waiting one is asked for": (
        WAITS,
        life.NodeAsked(20, "a", RESTART, BY),
        WAITS._replace(restarts=0),
        (Record("node-asked", "a", {"asked": RESTART, "by": BY}),),
    ),
    "the end that a restart needs": (
        RELOADS._replace(asked=RESTART),
        exited(),
        RUNS._replace(state="starting", pid=0, since_us=20, asked=RESTART, exit=CRASH),
        (Record("node-exited", "a", {"exit": "exit code 1", "asked": RESTART}),),
    ),
    "a restart that dora refuses": (
        RELOADS._replace(asked=RESTART),
        life.NodeKept(20, "a", RUNS),
        RUNS,
        (),
    ),
    "a restart that dora refuses after the end": (
        RELOADS._replace(asked=RESTART, pid=0),
        life.NodeKept(20, "a", RUNS),
        RELOADS._replace(asked=RESTART, pid=0),
        (),
    ),
    "a stop that dora refuses": (
        STOPPED,
        life.NodeKept(20, "a", RUNS),
        RUNS,
        (),
    ),
    "the end that a reload needs": (
        RELOADS,
        exited(),
        RELOADS._replace(pid=0),
        (Record("node-exited", "a", {"exit": "exit code 1"}),),
    ),
    "the end of a stopped one": (
        STOPPED,
        exited(),
        STOPPED._replace(pid=0, exit=CRASH),
        (Record("node-exited", "a", {"exit": "exit code 1", "asked": STOP}),),
    ),
    "the end of a launcher that waits": (
        STOPPED._replace(is_held=True),
        exited(),
        STOPPED._replace(pid=0),
        (),
    ),
    "the process before a wait": (WAITS, exited(), WAITS._replace(pid=0), ()),
    "a launcher that was replaced": (WAITS, exited(is_stale=True), WAITS, ()),
    "a stale exit": (RUNS, exited(is_stale=True), RUNS, ()),
    "a stale exit before a restart": (
        RUNS,
        exited(again=True, is_stale=True),
        RUNS._replace(restarts=2),
        (crashed(), RESTARTED),
    ),
    "a stale exit of a hung one before a restart": (
        RUNS._replace(hung="unresponsive"),
        exited(exit_of(-9), again=True, is_stale=True),
        RUNS._replace(restarts=2),
        (crashed({"exit": "hung, unresponsive"}, "node-ended"), RESTARTED),
    ),
    "the end of the process before, after that of the new one": (
        RUNS._replace(state="failed", pid=0, exit=CRASH, policy="never"),
        exited(exit_of(-15)),
        RUNS._replace(state="failed", pid=0, exit=CRASH, policy="never"),
        (),
    ),
    "one that waits for a reload": (
        RUNS._replace(policy=HELD),
        exited(again=True),
        RUNS._replace(state="failed", pid=0, since_us=20, exit=CRASH, policy=HELD),
        (crashed(),),
    ),
    "it lacks something": (
        SILENT._replace(hung="x"),
        life.NodeLacks(20, "a", "/dev/x"),
        WAITS._replace(since_us=20),
        (Record("node-waiting", "a", {"reason": "/dev/x"}),),
    ),
    "it lacks something else": (
        WAITS,
        life.NodeLacks(20, "a", "/dev/y"),
        WAITS._replace(needs="/dev/y"),
        (),
    ),
    "all is there": (
        WAITS,
        life.NodeMet(65 * SECOND, "a"),
        RUNS._replace(state="starting", restarts=0, since_us=65 * SECOND),
        (Record("node-needs-met", "a", {"reason": "after 1min 4s"}),),
    ),
    "all is there at once": (
        WAITS,
        life.NodeMet(10, "a"),
        RUNS._replace(state="starting", restarts=0, since_us=10),
        (Record("node-needs-met", "a", {"reason": "after 0"}),),
    ),
    "nothing was missing": (RUNS, life.NodeMet(20, "a"), RUNS, ()),
    "ended with another one": (
        RUNS,
        life.NodeCascaded(20, "a", "b"),
        RUNS._replace(state="failed", since_us=20, exit=Exit(by="b")),
        (),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_one_event(case: str) -> None:
    before, event, after, records = CASES[case]
    nodes, told = update({"a": before}, event, is_stopping=False, is_open=True)
    assert nodes == {"a": after}
    assert told == records


@pytest.mark.parametrize(
    "event",
    [
        life.NodeHung(1, "x", "unresponsive"),
        life.NodeSilent(1, "x", "image", "r", "restart", "s"),
        life.NodeSpeaks(1, "x", "image", "r", ""),
        life.NodeAsked(1, "x", STOP, BY),
    ],
)
def test_a_node_that_is_not_in_the_table(event: life.Event) -> None:
    told = update({"a": RUNS}, event, is_stopping=False, is_open=True)
    assert told == ({"a": RUNS}, ())


def test_a_node_is_ready_before_the_barrier_opens() -> None:
    nodes, _ = update(
        {"a": RUNS._replace(state="starting")},
        life.NodeReady(20, "a"),
        is_stopping=False,
        is_open=False,
    )
    assert nodes["a"].state == "ready"
    opened = all_ready({**nodes, "b": WAITS}, 30)
    assert (opened["a"].state, opened["a"].since_us, opened["b"]) == ("running", 30, WAITS)


def test_how_a_node_ends_while_all_stop() -> None:
    nodes, records = update({"a": RUNS}, exited(again=True), is_stopping=True, is_open=True)
    assert nodes["a"] == RUNS._replace(state="stopped", pid=0, since_us=20, exit=CRASH)
    assert records == (Record("node-exited", "a", {"exit": "exit code 1"}),)


OOM = Oom(Owner.NODE, 1 << 20, 1 << 20)
OF_ALL = Oom(Owner.DATAFLOW, 1 << 20, 1 << 30, "a", 1 << 20)


@pytest.mark.parametrize("is_stopping", [True, False])
def test_a_node_that_used_up_its_memory(is_stopping: bool) -> None:
    event = replace(exited(Exit(words=OOM.text)), oom=OOM)
    _, (record,) = update({"a": RUNS}, event, is_stopping=is_stopping, is_open=True)
    assert record == Record("node-oom", "a", OOM.node_details())


def cell(state: State = State.RUNNING, **changes: object) -> Cell:
    ready = 1 if state is State.RUNNING else 0
    one = Cell(10 * SECOND, 0, {"a": RUNS}, state, run="r", ready_us=ready)
    return replace(one, **changes)  # type: ignore[arg-type]


def records_of(actions: tuple[object, ...]) -> list[Record]:
    return [one for one in actions if isinstance(one, Record)]


@pytest.mark.parametrize("child", ["daemon", "coordinator"])
def test_the_loss_of_dora(child: str) -> None:
    after, actions = step(cell(), life.ChildExited(1, child, exit_of(-9)))
    reason = f"the dora {child} is gone (signal SIGKILL)"
    assert (after.failure, after.exit, after.state) == (
        *(reason, RunnerExit.ENGINE_LOST),
        State.ENDED,
    )
    lost = f"{child}-lost"
    assert records_of(actions) == [
        Record(lost, "", {"exit": "signal SIGKILL"}),
        Record("dataflow-failed", "", {"reason": reason, "cause": lost}),
    ]


def test_the_loss_of_dora_because_of_memory() -> None:
    exit = Exit(words=OF_ALL.text)
    after, actions = step(cell(), life.ChildExited(1, "daemon", exit, OF_ALL))
    assert after.cause is Cause.OUT_OF_MEMORY
    reason = f"the dora daemon is gone ({OF_ALL.text})"
    assert records_of(actions) == [
        Record("dataflow-oom", "", OF_ALL.dataflow_details()),
        Record("daemon-lost", "", {"exit": OF_ALL.text}),
        Record(
            "dataflow-failed",
            "",
            {"reason": reason, "cause": "out-of-memory", **OF_ALL.owner_details()},
        ),
    ]


def test_the_loss_of_the_connection() -> None:
    after, actions = step(cell(), life.ConnectionLost(1))
    reason = "the dora coordinator closed the control connection"
    assert (after.failure, after.cause) == (reason, Cause.COORDINATOR_LOST)
    assert records_of(actions)[0] == Record("coordinator-lost", "", {})


def test_a_failure_names_who_caused_it() -> None:
    blamed = cell(State.LEAVING, failure="r", cause=Cause.NODE_FAILED, culprits=("a", "b"))
    after, actions = step(blamed, life.ChildExited(1, "daemon", Exit()))
    details = {"reason": "r", "cause": "node-failed", "nodes": "a b"}
    assert records_of(actions) == [Record("dataflow-failed", "", details)]
    assert after.state is State.ENDED


@pytest.mark.parametrize(
    ("before", "event", "wanted"),
    [
        (cell(State.BOOTING), life.CoordinatorListening(1), ENGINE_TIMEOUT),
        (cell(State.JOINING), life.DaemonConnected(1), ENGINE_TIMEOUT),
        (cell(State.STARTING), life.Subscribed(1), None),
        (cell(State.WAITING), life.AllReady(1), None),
        (cell(), life.StopAsked(1, "SIGTERM"), stop_timeout(10 * SECOND)),
        (cell(State.STOPPING), life.StopAnswered(1), LEAVE_TIMEOUT),
        (cell(State.WAITING), life.RunFinished(1), ENGINE_TIMEOUT),
        (cell(), life.RunFinished(1), ENGINE_TIMEOUT),
        (cell(State.CLOSING), life.ResultKnown(1, {"a": Exit()}), LEAVE_TIMEOUT),
    ],
)
def test_the_time_of_each_state(before: Cell, event: life.Event, wanted: int | None) -> None:
    _, actions = step(before, event)
    assert [one for one in actions if isinstance(one, Deadline)] == [Deadline(wanted)]


def test_the_barrier_that_opens_after_a_failure() -> None:
    failed = cell(State.WAITING, nodes={"a": RUNS._replace(state="failed"), "b": RUNS})
    after, actions = step(failed, life.AllReady(1))
    assert (after.state, actions) == (State.WAITING, (Deadline(CASCADE_TIMEOUT),))


@pytest.mark.parametrize(("ready_us", "state"), [(0, "ready"), (1, "running")])
def test_a_ready_node_runs_once_the_barrier_is_open(ready_us: int, state: str) -> None:
    nodes = {"a": RUNS._replace(state="starting")}
    after, _ = step(cell(State.WAITING, ready_us=ready_us, nodes=nodes), life.NodeReady(1, "a"))
    assert after.nodes["a"].state == state


def test_a_silent_node_may_end_all() -> None:
    event = life.NodeSilent(1, "a", "image", "no image for 2s", "fail", "no image for 2s")
    after, actions = step(cell(), event)
    assert (after.failure, after.exit, after.cause, after.culprits) == (
        *("node a: no image for 2s", RunnerExit.FAILED),
        *(Cause.NODE_SILENT, ("a",)),
    )
    assert Do.ASK_STOP in actions


def head(state: State, **changes: object) -> Cell:
    return cell(state, members=("gpu",), **changes)


def member(state: State) -> Cell:
    return cell(state, machine="gpu")


@pytest.mark.parametrize(
    ("before", "event", "records"),
    [
        (
            head(State.GATHERING),
            life.MachineJoined(1, "gpu"),
            [Record("machine-joined", "", {"machine": "gpu"})],
        ),
        (
            head(State.RUNNING),
            life.MachineLost(1, "gpu", "no word"),
            [Record("machine-lost", "", {"machine": "gpu", "reason": "no word"})],
        ),
        (
            member(State.RUNNING),
            life.HeadStops(1, "SIGINT"),
            [Record("dataflow-stopping", "", {"by": "SIGINT"})],
        ),
        (
            replace(member(State.RUNNING), nodes={}),
            life.HeadStops(1, "SIGINT"),
            [Record("dataflow-stopping", "", {"by": "SIGINT"})],
        ),
        (
            member(State.RUNNING),
            life.HeadLost(1, "no word"),
            [
                Record("machine-lost", "", {"machine": "head", "reason": "no word"}),
                Record("dataflow-stopping", "", {"by": "head"}),
            ],
        ),
        (
            member(State.GATHERING),
            life.HeadLost(1, "no word"),
            [
                Record("dataflow-stopping", "", {"by": "head"}),
                Record("dataflow-stopped"),
            ],
        ),
        (
            member(State.GATHERING),
            life.HeadStops(1, "SIGINT"),
            [
                Record("dataflow-stopping", "", {"by": "SIGINT"}),
                Record("dataflow-stopped"),
            ],
        ),
    ],
)
def test_what_is_told_of_machines(before: Cell, event: life.Event, records: list[Record]) -> None:
    _, actions = step(before, event)
    assert records_of(actions) == records


def test_what_is_missing_is_forgotten_when_all_are_there() -> None:
    after, _ = step(head(State.GATHERING, awaited="waiting for gpu"), life.Gathered(1))
    assert (after.awaited, after.state) == ("", State.STARTING)


@pytest.mark.parametrize(
    ("before", "how", "after"),
    [
        (RUNS, Exit(), ("finished", Exit(), 0)),
        (RUNS, CRASH, ("failed", CRASH, 0)),
        (RUNS._replace(state="failed", exit=CRASH, pid=0), Exit(), ("failed", CRASH, 0)),
        (RUNS._replace(state="stopped", pid=0), Exit(), ("stopped", Exit(), 0)),
        (RUNS._replace(state="stopped", pid=0), CRASH, ("failed", CRASH, 0)),
        (
            RUNS._replace(exit=Exit(words=OOM.text)),
            exit_of(-9),
            ("failed", Exit(words=OOM.text), 0),
        ),
        (RUNS._replace(exit=CRASH), exit_of(2), ("failed", exit_of(2), 0)),
        (RUNS, exit_of(-9), ("failed", exit_of(-9), 0)),
        (STOPPED, CRASH, ("stopped", Exit(), 7)),
    ],
)
def test_the_result_of_a_node(before: NodeStatus, how: Exit, after: tuple[str, Exit, int]) -> None:
    """dora only knows the signal of an OOM kill."""
    nodes = apply_results({"a": before}, {"a": how, "x": Exit()}, 30)
    node = nodes["a"]
    assert (node.state, node.exit, node.pid) == after
    assert node.since_us == (30 if node.state != before.state else before.since_us)
    assert set(nodes) == {"a"}


@pytest.mark.parametrize(
    ("node", "words"),
    [
        (RUNS._replace(state="failed", exit=CRASH), "exit code 1 after 1 restart"),
        (RUNS._replace(state="failed", restarts=2), "ended after 2 restarts"),
        (RUNS._replace(state="failed", exit=Exit(by="b")), ""),
        (RUNS._replace(state="failed", exit=CRASH, policy="never"), ""),
        (RUNS._replace(state="failed", exit=CRASH, policy=HELD), ""),
        (RUNS._replace(state="failed", exit=CRASH, policy=LATCHED), ""),
        (RUNS._replace(state="finished", policy="always", restarts=3), "ended after 3 restarts"),
        (RUNS._replace(state="finished", policy="always", restarts=2), ""),
        (RUNS._replace(state="finished", policy="always", restarts=9, max_restarts=0), ""),
        (RUNS._replace(state="finished", restarts=3), ""),
        (RUNS, ""),
    ],
)
def test_who_has_used_up_its_restarts(node: NodeStatus, words: str) -> None:
    assert spent({"a": node}) == ({"a": words} if words else {})


def test_a_dataflow_that_is_over_but_for_held_nodes() -> None:
    done, held = RUNS._replace(state="finished", pid=0), STOPPED
    assert is_over_but_for_held({"a": done, "b": held})
    assert not is_over_but_for_held({"a": RUNS, "b": held})
    assert not is_over_but_for_held({"a": done, "b": held._replace(pid=0)})
    assert not is_over_but_for_held({"b": held})
    assert not is_over_but_for_held({})


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (199, ""),
        (200, "its working directory could not be entered (exit code 200/CHDIR)"),
        (223, "systemd could not start its process (exit code 223)"),
        (245, "systemd could not start its process (exit code 245/KSM)"),
        (246, ""),
        (1, ""),
        (255, ""),
    ],
)
def test_what_systemd_could_not_do(status: int, words: str) -> None:
    assert setup_failure(status) == words


@pytest.mark.parametrize(
    ("result", "words"),
    [
        ("oom-kill", "it ran out of memory"),
        ("protocol", "its supervisor process ended without a message"),
        ("exit-code", ""),
        ("", ""),
    ],
)
def test_what_a_result_of_systemd_means(result: str, words: str) -> None:
    assert result_words(result) == words


@pytest.mark.parametrize(
    ("before", "text"),
    [
        (
            cell(
                State.WAITING,
                nodes={"a": RUNS._replace(state="ready"), "b": RUNS._replace(state="failed")},
            ),
            "1/2 nodes ready; failed: b",
        ),
        (
            cell(
                nodes={
                    **{"a": RUNS, "b": RUNS._replace(state="starting")},
                    **{"c": RUNS._replace(state="restarting", exit=CRASH), "d": RELOADS},
                    **{"e": STOPPED, "f": RUNS._replace(silent="no image for 2s")},
                },
                notice="not reloaded: x",
            ),
            "2/6 nodes running; starting: b; restarting: c (exit code 1); reloading: d; "
            "stopped: e; silent: f (no image for 2s); not reloaded: x",
        ),
        (cell(State.STOPPING, grace=INFINITY), "stopping, waiting for a"),
        (cell(State.GATHERING, members=("gpu", "cam")), "waiting for gpu, cam"),
        (cell(State.BOOTING, machine="gpu"), "waiting for the head"),
        (cell(State.STARTING, machine="gpu"), "starting the nodes"),
    ],
)
def test_one_line_of_status(before: Cell, text: str) -> None:
    assert format_status(before) == text


def test_the_whole_table() -> None:
    table = cell_status(cell(started_us=3, ready_us=4), "uuid", (), {}, {})
    assert (table.uuid, table.run, table.stage, table.text) == (
        *("uuid", "r", "running"),
        "1/1 nodes running",
    )
    assert (table.started_us, table.ready_us, table.nodes) == (3, 4, {"a": RUNS})


@pytest.mark.parametrize(
    ("raw", "policy", "most"),
    [
        ({}, "never", 0),
        ({"restart_policy": "always", "max_restarts": 2}, "always", 2),
        ({"restart_policy": "always", "restart_delay": HELD_SECONDS, "max_restarts": 2}, HELD, 2),
        (
            {"restart_policy": "always", "restart_delay": LATCH_SECONDS, "max_restarts": 1},
            LATCHED,
            0,
        ),
    ],
)
def test_the_table_begins_with_what_the_descriptor_says(
    raw: dict[str, object], policy: str, most: int
) -> None:
    nodes = initial_nodes({"a": "uv"}, {"nodes": [{"id": "a", **raw}, {"id": "other"}]}, 5)
    assert nodes == {"a": NodeStatus("starting", 0, 0, 5, Exit(), "uv", policy, most)}


@pytest.mark.parametrize(
    ("before", "is_ready"),
    [
        (cell(), True),
        (cell(State.WAITING), False),
        (cell(State.WAITING, nodes={"a": WAITS}), True),
        (cell(State.ENDED), True),
        (cell(State.ENDED, exit=RunnerExit.FAILED_AT_STOP), True),
        (cell(State.ENDED, exit=RunnerExit.FAILED), False),
        (cell(State.ENDED, reload=True), False),
    ],
)
def test_when_systemd_is_told_that_it_is_ready(before: Cell, is_ready: bool) -> None:
    assert is_up(before) == is_ready


def test_a_node_that_is_not_in_the_table_has_not_waited() -> None:
    told = update({"a": RUNS}, life.NodeMet(1, "x"), is_stopping=False, is_open=True)
    assert told == ({"a": RUNS}, ())


@pytest.mark.parametrize("state", [State.BOOTING, State.JOINING, State.STARTING])
def test_a_stop_before_the_nodes_run(state: State) -> None:
    after, actions = step(cell(state), life.StopAsked(1, "SIGTERM"))
    assert (after.state, after.stop_by, format_status(after)) == (State.ENDED, "SIGTERM", "stopped")
    assert [one.event for one in records_of(actions)] == ["dataflow-stopping", "dataflow-stopped"]


@pytest.mark.parametrize(
    ("cause", "code"),
    [
        (Cause.REFUSED, RunnerExit.FAILED),
        (Cause.NO_MACHINE, RunnerExit.NO_MACHINE),
        (Cause.MACHINE_REFUSES, RunnerExit.BAD_DATAFLOW),
    ],
)
def test_a_refusal_is_told_as_it_was_said(cause: Cause, code: RunnerExit) -> None:
    after, actions = step(cell(State.STARTING), life.Refused(1, "no such operator", cause))
    assert (after.failure, after.exit, after.cause) == ("no such operator", code, cause)
    details = {"reason": "no such operator", "cause": str(cause)}
    assert records_of(actions)[-1] == Record("dataflow-failed", "", details)


def test_a_stop_while_a_failed_node_ends_all_leaves_no_failure() -> None:
    """Who stops it does not want to hear of that."""
    failing = cell(State.LEAVING, failure="x", exit=RunnerExit.FAILED, stop_by="SIGTERM")
    after, _ = step(failing, life.ChildExited(1, "daemon", Exit()))
    assert (after.failure, after.exit, format_status(after)) == ("", RunnerExit.OK, "stopped")


def test_what_a_start_waits_for() -> None:
    waits = WAITS._replace(since_us=0)
    text = format_status(cell(State.WAITING, nodes={"a": RUNS._replace(state="ready"), "b": waits}))
    assert text.startswith("1/2 nodes ready; b waits for /dev/x")
