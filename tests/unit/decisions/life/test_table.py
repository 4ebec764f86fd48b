"""The runner's state machine: every pair of state and event, and whole lives as tables."""

from dataclasses import replace
from typing import get_type_hints

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.owes import THEN
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.failures import ENGINE_TIMEOUT
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import (
    Action,
    Cell,
    Deadline,
    Do,
    Record,
    State,
)
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.life.table import TABLE, step
from dora_systemd.decisions.life.view import is_up
from dora_systemd.decisions.logs.journal_events import END_EVENTS
from dora_systemd.values import INFINITY, SECOND

SAMPLES: dict[type[life.Event], tuple[life.Event, ...]] = {
    life.CoordinatorListening: (life.CoordinatorListening(1),),
    life.DaemonConnected: (life.DaemonConnected(1),),
    life.RunStarted: (life.RunStarted(1, "run"),),
    life.Subscribed: (life.Subscribed(1),),
    life.Refused: (life.Refused(1, "no"),),
    life.Failed: (life.Failed(1, "start the daemon", "OSError: no"),),
    life.NodeSpawned: (life.NodeSpawned(1, "a", 7), life.NodeSpawned(1, "unknown", 7)),
    life.NodeReady: (life.NodeReady(1, "a"), life.NodeReady(1, "unknown")),
    life.AllReady: (life.AllReady(1),),
    life.NodeExited: (
        life.NodeExited(1, "a", Exit(), False),
        life.NodeExited(1, "a", exit_of(1), False),
        life.NodeExited(1, "a", exit_of(-9), True),
        life.NodeExited(1, "a", Exit(), False, is_stale=True),
        life.NodeExited(1, "unknown", Exit(), True, is_stale=True),
    ),
    life.NodeCascaded: (life.NodeCascaded(1, "a", "b"),),
    life.NodeLacks: (life.NodeLacks(1, "a", "/dev/video0 (not there)"),),
    life.NodeMet: (life.NodeMet(1, "a"),),
    life.NodeHung: (life.NodeHung(1, "a", "unresponsive"), life.NodeHung(1, "unknown", "")),
    life.NodeSilent: tuple(
        life.NodeSilent(1, node, "image", "no image for 2s", then, "no image for 2s")
        for node in ("a", "unknown")
        for then in THEN
    ),
    life.NodeSpeaks: (life.NodeSpeaks(1, "a", "image", "image again", ""),),
    life.StartTimedOut: (life.StartTimedOut(1, 1_000_000),),
    life.RunFinished: (life.RunFinished(1),),
    life.ResultKnown: (life.ResultKnown(1), life.ResultKnown(1, {"a": Exit(), "b": exit_of(1)})),
    life.ChildExited: (
        life.ChildExited(1, "daemon", exit_of(-9)),
        life.ChildExited(1, "coordinator", exit_of(1)),
    ),
    life.ConnectionLost: (life.ConnectionLost(1),),
    life.StopAsked: (life.StopAsked(1, "SIGTERM"),),
    life.StopAnswered: (life.StopAnswered(1),),
    life.NodeReloading: (life.NodeReloading(1, "a"),),
    life.NodeOverdue: (life.NodeOverdue(1, "a"), life.NodeOverdue(1, "unknown")),
    life.NodeExtends: (
        life.NodeExtends(1, "a", SECOND, 0),
        life.NodeExtends(1, "unknown", INFINITY, SECOND),
    ),
    life.NodeAsked: (
        life.NodeAsked(1, "a", "restart", "root"),
        life.NodeAsked(1, "a", "stop", "root"),
    ),
    life.NodeKept: (
        life.NodeKept(1, "a", NodeStatus("running", 7)),
        life.NodeKept(1, "unknown", NodeStatus()),
    ),
    life.NodeAdded: (life.NodeAdded(1, "c", NodeStatus()),),
    life.NodeRemoved: (life.NodeRemoved(1, "a"), life.NodeRemoved(1, "unknown")),
    life.ReloadNoted: (life.ReloadNoted(1, "a.py: line 3: invalid syntax"),),
    life.ReloadAsked: (life.ReloadAsked(1),),
    life.MachinesAwaited: (life.MachinesAwaited(1, "waiting for machine gpu"),),
    life.MachineJoined: (life.MachineJoined(1, "gpu"),),
    life.Gathered: (life.Gathered(1),),
    life.MachineLost: (
        life.MachineLost(1, "gpu", "no word for 7s"),
        life.MachineLost(1, "gpu", "", by="SIGTERM"),
        life.MachineLost(1, "gpu", "", by="SIGTERM", is_waiting=True),
    ),
    life.HeadStops: (life.HeadStops(1, "SIGTERM"), life.HeadStops(1, "SIGTERM", 60 * SECOND)),
    life.NodeTurn: (life.NodeTurn(1, "a", SECOND), life.NodeTurn(1, "unknown", SECOND)),
    life.HeadLost: (life.HeadLost(1, "no word for 7s"),),
    life.DeadlinePassed: (life.DeadlinePassed(1),),
}


def cell(state: State = State.BOOTING, **changes: object) -> Cell:
    nodes = {"a": NodeStatus("running", 7), "b": NodeStatus("running", 8)}
    return replace(Cell(10 * SECOND, 0, nodes, state), **changes)  # type: ignore[arg-type]


def test_the_table_is_total() -> None:
    assert set(TABLE) == set(State)
    for row in TABLE.values():
        assert set(row) == set(life.EVENTS) == set(SAMPLES)


EACH = [event for events in SAMPLES.values() for event in events]


ORDERED: dict[str, object] = {
    "ready_us": 1,
    "stops": {"a": NodeStop("a", SECOND, ("b",))},
    "stop_limit": 60 * SECOND,
}


MEMBER = {**ORDERED, "machine": "gpu", "awaits_head": True}


@pytest.mark.parametrize("changes", [{}, ORDERED, MEMBER], ids=["plain", "ordered", "member"])
@pytest.mark.parametrize("state", State)
def test_every_pair(state: State, changes: dict[str, object]) -> None:
    for event in EACH:
        after, actions = step(cell(state, **changes), event)
        is_end = after.state is State.ENDED and state is not State.ENDED
        assert (Do.EXIT in actions) == is_end, event
        if after.state is not state:
            deadlines = [one for one in actions if isinstance(one, Deadline)]
            assert len(deadlines) == 1, f"{event}: a change of state sets or clears the deadline"
        if state is State.ENDED:
            assert (after, actions) == (cell(state, **changes), ()), event


@pytest.mark.parametrize("state", [s for s in State if s is not State.ENDED])
def test_each_state_ends_when_it_is_told_to_and_nothing_answers(state: State) -> None:
    now = cell(state)
    for event in (life.StopAsked(1, "SIGTERM"), *[life.DeadlinePassed(2)] * 3):
        now = step(now, event)[0]
    assert now.state is State.ENDED
    if state not in (State.CLOSING,):
        assert now.exit is RunnerExit.OK


LIVING = [state for state in State if state is not State.ENDED]
CHANGES: list[dict[str, object]] = [
    {},
    ORDERED,
    {"stop_by": "SIGTERM"},
    {"is_trial": True, "stop_by": "SIGTERM"},
    {"failure": "node a: exit code 1", "exit": RunnerExit.NODES_FAILED},
]


@pytest.mark.parametrize("changes", CHANGES, ids=str)
@pytest.mark.parametrize("state", LIVING)
def test_every_pair_when_its_action_raises(state: State, changes: dict[str, object]) -> None:
    broken = life.Failed(2, "do it", "OSError: no")
    for event in EACH:
        between, before = step(cell(state, **changes), event)
        after, actions = step(between, broken)
        done = (*before, *actions)
        assert after.state is State.ENDED, event
        assert done.count(Do.EXIT) == 1, f"{event}: EXIT is reachable from every state"
        told = [one for one in done if isinstance(one, Record) and one.event in END_EVENTS]
        assert len(told) == 1, f"{event}: its end has one name"


@pytest.mark.parametrize("state", [s for s in LIVING if s is not State.LEAVING])
def test_what_raised_has_its_name_in_the_journal(state: State) -> None:
    after, actions = step(cell(state), life.Failed(1, "start the daemon", "OSError: no"))
    assert after.failure == "the runner could not start the daemon: OSError: no"
    details = {"reason": after.failure, "cause": "runner-broken"}
    assert Record("dataflow-failed", "", details) in actions
    assert after.exit is RunnerExit.FAILED


def test_no_run_follows_one_that_raised_while_a_reload_ended_it() -> None:
    after, _ = step(cell(State.STOPPING, reload=True), life.Failed(1, "ask dora to stop", "no"))
    assert (after.reload, after.exit) == (False, RunnerExit.FAILED)


def test_an_end_that_is_known_stays_known() -> None:
    known = cell(State.LEAVING, failure="node a: exit code 1", exit=RunnerExit.NODES_FAILED)
    for now in (known, replace(known, state=State.STOPPING)):
        after, _ = step(now, life.Failed(1, "tell the daemon to end", "OSError: no"))
        assert (after.failure, after.exit) == (known.failure, known.exit)
    after, actions = step(cell(State.LEAVING), life.Failed(1, "x", "y"))
    assert Record("dataflow-finished") in actions


def live(*events: life.Event, nodes: tuple[str, ...] = ("a", "b")) -> tuple[Cell, list[Action]]:
    now = Cell(2 * SECOND, 0, {n: NodeStatus() for n in nodes})
    done: list[Action] = []
    for event in events:
        now, actions = step(now, event)
        done += [action for action in actions if not isinstance(action, Deadline)]
    return now, done


START = (
    life.CoordinatorListening(1),
    life.DaemonConnected(2),
    life.RunStarted(3, "run"),
    life.Subscribed(4),
)
READY = (
    *START,
    life.NodeSpawned(5, "a", 7),
    life.NodeSpawned(5, "b", 8),
    life.NodeReady(6, "a"),
    life.NodeReady(7, "b"),
    life.AllReady(8),
)
ASKED = [
    Do.START_DAEMON,
    Do.SEND_START,
    Do.SUBSCRIBE,
    Do.OPEN_PIPES,
    Do.ASK_SPAWN,
    Do.ASK_RESULT,
]


def test_history_ready() -> None:
    now, done = live(*READY)
    assert now.state is State.RUNNING
    assert now.ready_us == 8
    assert [one for one in done if isinstance(one, Do)] == ASKED
    assert done[-1] == Record("dataflow-started")
    assert [node.state for node in now.nodes.values()] == ["running", "running"]


def test_history_stop() -> None:
    now, done = live(
        *READY,
        life.StopAsked(9, "SIGTERM"),
        life.NodeExited(10, "a", Exit(), False),
        life.NodeExited(10, "b", exit_of(-15), False),
        life.ChildExited(11, "daemon", exit_of(0)),
    )
    assert now.exit is RunnerExit.OK
    ends = done[done.index(Record("dataflow-stopping", "", {"by": "SIGTERM"})) :]
    assert [one for one in ends if isinstance(one, Do)] == [
        Do.ASK_STOP,
        Do.DISMISS_DAEMON,
        Do.EXIT,
    ]
    assert Record("dataflow-stopped") in ends
    assert not [one for one in ends if isinstance(one, Record) and one.event == "node-crashed"]


def test_history_finish() -> None:
    now, done = live(
        *READY,
        life.NodeExited(9, "a", Exit(), False),
        life.NodeExited(9, "b", Exit(), False),
        life.RunFinished(10),
        life.ResultKnown(11, {"a": Exit(), "b": Exit()}),
        life.ChildExited(12, "daemon", exit_of(0)),
    )
    assert now.exit is RunnerExit.OK
    assert done[-2:] == [Record("dataflow-finished"), Do.EXIT]


def test_history_finish_at_once() -> None:
    """The end of the run is reported before, or without, the opening of the start barrier."""
    now, done = live(
        *START,
        life.NodeExited(9, "a", Exit(), False),
        life.NodeExited(9, "b", Exit(), False),
        life.RunFinished(10),
        life.ResultKnown(11, {"a": Exit(), "b": Exit()}),
        life.ChildExited(12, "daemon", exit_of(0)),
    )
    assert now.exit is RunnerExit.OK
    assert now.ready_us == 11
    assert is_up(now)
    assert [one.event for one in done if isinstance(one, Record)][-2:] == [
        "dataflow-started",
        "dataflow-finished",
    ]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"exit": RunnerExit.OK}, True),
        ({"exit": RunnerExit.FAILED_AT_STOP}, True),
        ({"exit": RunnerExit.OK, "reload": True}, False),
        ({"exit": RunnerExit.FAILED}, False),
        ({"exit": RunnerExit.BAD_DATAFLOW}, False),
    ],
)
def test_systemd_hears_of_a_good_end_before_the_start(
    changes: dict[str, object], expected: bool
) -> None:
    """Otherwise it calls that a failure: Result=protocol."""
    assert is_up(cell(State.ENDED, **changes)) is expected
    assert not is_up(cell(State.LEAVING, **changes))


def test_history_failed_before_ready() -> None:
    now, done = live(
        *START,
        life.NodeExited(9, "a", exit_of(1), False),
        life.NodeCascaded(9, "b", "a"),
        life.RunFinished(10),
        life.ResultKnown(11, {"a": exit_of(1), "b": exit_of(1)._replace(by="a")}),
        life.ChildExited(12, "daemon", exit_of(0)),
    )
    assert now.exit is RunnerExit.FAILED
    assert Record("node-crashed", "a", {"exit": "exit code 1"}) in done
    assert now.failure.startswith("node a: exit code 1")


def test_the_barrier_opens_although_a_node_has_failed() -> None:
    failed = (*START, life.NodeExited(5, "a", exit_of(1), False), life.NodeReady(6, "b"))
    now, done = live(*failed, life.AllReady(7))
    assert now.state is State.WAITING
    assert Record("dataflow-started") not in done
    now, actions = step(now, life.DeadlinePassed(8))
    assert now.state is State.RUNNING
    assert Record("dataflow-started") in actions


EARLY_END = (
    *START,
    life.NodeReady(5, "b"),
    life.NodeExited(6, "a", Exit(), False),
    life.AllReady(7),
)


def test_a_node_that_ends_before_it_calls_dora_has_failed_the_others() -> None:
    now, done = live(
        *EARLY_END,
        life.NodeExited(8, "b", exit_of(1), False),
        life.NodeCascaded(8, "b", "a"),
        life.RunFinished(10),
        life.ResultKnown(11, {"a": Exit(), "b": exit_of(1)._replace(by="a")}),
        life.ChildExited(12, "daemon", exit_of(0)),
    )
    assert "dataflow-started" not in [one.event for one in done if isinstance(one, Record)]
    assert [one for one in done if isinstance(one, Record)][-3:] == [
        Record("node-crashed", "a", {"exit": "exit code 0 before it called dora"}),
        Record("node-crashed", "b", {"exit": "exit code 1 because node a failed"}),
        Record("dataflow-failed", "", {"reason": now.failure, "cause": "node-failed",
                                       "nodes": "a b"}),
    ]  # fmt: skip
    assert now.failure == (
        "node a: exit code 0 before it called dora, node b: exit code 1 because node a failed"
    )
    assert (now.exit, now.nodes["a"].state) == (RunnerExit.FAILED, "failed")


@pytest.mark.parametrize("policies", [("on-failure", "on-failure"), ("on-failure", "never")])
def test_an_early_end_fails_no_start_of_nodes_that_dora_restarts(policies: tuple[str, str]) -> None:
    now, _ = live(*EARLY_END[:-1])
    statuses = zip(now.nodes.items(), policies, strict=True)
    now = replace(now, nodes={key: one._replace(policy=how) for (key, one), how in statuses})
    after, _ = step(now, EARLY_END[-1])
    is_doomed = policies[1] == "never"
    assert after.state is (State.WAITING if is_doomed else State.RUNNING)
    ended = life.NodeExited(8, "b", exit_of(1), not is_doomed)
    assert step(after, ended)[0].nodes["a"].state == ("failed" if is_doomed else "finished")


def test_a_killed_node_that_was_ready_has_failed_nobody() -> None:
    ready = (*START, life.NodeReady(5, "a"), life.NodeReady(5, "b"))
    now, _ = live(*ready, *(life.NodeExited(6, node, exit_of(-9), False) for node in ("a", "b")))
    assert [str(node.exit) for node in now.nodes.values()] == ["signal SIGKILL"] * 2


def test_dora_may_say_only_in_its_result_who_ended_early() -> None:
    ends = {"a": exit_of(1)._replace(by="b"), "b": Exit()}
    now, _ = live(*READY, life.RunFinished(10), life.ResultKnown(11, ends))
    assert now.failure == (
        "node b: exit code 0 before it called dora, node a: exit code 1 because node b failed"
    )


def test_what_failed_by_itself_is_named_first() -> None:
    """dora reports the nodes in any order."""
    ends = {"a": exit_of(1)._replace(by="b"), "b": exit_of(1)}
    now, _ = live(*READY, life.RunFinished(10), life.ResultKnown(11, ends))
    assert now.failure == "node b: exit code 1, node a: exit code 1 because node b failed"
    assert [*now.culprits] == ["b", "a"]


def test_an_empty_result_is_unknown_and_not_success() -> None:
    now, _ = live(*READY, life.RunFinished(10), life.ResultKnown(11))
    assert now.exit is RunnerExit.ENGINE_LOST


def test_stop_does_not_wait_for_a_node_in_its_restart_delay() -> None:
    now, done = live(
        *READY,
        life.NodeExited(9, "a", Exit(), False),
        life.NodeExited(9, "b", exit_of(1), True),
        life.StopAsked(10, "SIGTERM"),
    )
    assert now.state is State.LEAVING
    assert Do.ASK_STOP not in done


def test_stop_timeout_covers_what_dora_takes_to_kill() -> None:
    assert stop_timeout(10 * SECOND) == 17 * SECOND
    _, actions = step(cell(State.RUNNING), life.StopAsked(1, "x"))
    assert Deadline(17 * SECOND) in actions
    assert ENGINE_TIMEOUT == 30 * SECOND


def test_crash_restart_and_stale_exits() -> None:
    now, done = live(*READY, life.NodeExited(9, "a", exit_of(3), True))
    assert now.nodes["a"].state == "restarting"
    now, actions = step(now, life.NodeSpawned(10, "a", 70))
    assert actions == (Record("node-restarted", "a", {"restarts": "1"}),)
    now, _ = step(now, life.NodeExited(11, "a", exit_of(-9), False, is_stale=True))
    assert (now.nodes["a"].pid, now.nodes["a"].state) == (70, "starting")
    now, _ = step(now, life.NodeReady(12, "a"))
    assert (now.nodes["a"].state, now.nodes["a"].restarts) == ("running", 1)
    now, _ = step(now, life.NodeExited(13, "a", exit_of(-9), True, is_stale=True))
    assert (now.nodes["a"].pid, now.nodes["a"].restarts) == (70, 2)
    assert Record("node-crashed", "a", {"exit": "exit code 3"}) in done


def lives(now: Cell, *events: life.Event) -> tuple[Cell, list[object]]:
    done: list[object] = []
    for event in events:
        now, actions = step(now, event)
        done += [one for one in actions if not isinstance(one, Deadline)]
    return now, done


def test_a_reload_of_the_whole_ends_without_a_word() -> None:
    after, done = lives(
        cell(State.RUNNING),
        life.ReloadAsked(1),
        life.NodeExited(2, "a", Exit(), False),
        life.NodeExited(3, "b", Exit(), False),
        life.ChildExited(4, "daemon", exit_of(0)),
    )
    assert after.state is State.ENDED
    assert (after.reload, after.exit, after.failure) == (True, RunnerExit.OK, "")
    names = [one.event for one in done if isinstance(one, Record)]
    assert names == ["node-exited", "node-exited"]


def test_a_stop_is_stronger_than_a_reload() -> None:
    after, done = lives(
        cell(State.RUNNING),
        life.ReloadAsked(1),
        life.StopAsked(2, "SIGTERM"),
        life.StopAnswered(3),
        life.ChildExited(4, "daemon", exit_of(0)),
    )
    assert (after.state, after.reload, after.stop_by) == (State.ENDED, False, "SIGTERM")
    assert [one.event for one in done if isinstance(one, Record)] == [
        "dataflow-stopping",
        "dataflow-stopped",
    ]


@pytest.mark.parametrize(
    ("changes", "ends", "word"),
    [
        ({}, True, "dataflow-failed"),
        ({"is_again": True}, False, ""),
    ],
)
def test_a_held_node_that_fails_before_the_start(
    changes: dict[str, bool], ends: bool, word: str
) -> None:
    nodes = {"a": NodeStatus("starting", 7, policy=HELD), "b": NodeStatus("ready", 8)}
    now = cell(State.WAITING, nodes=nodes, **changes)
    after, done = lives(now, life.NodeExited(1, "a", exit_of(1), True))
    assert (after.state is State.ENDED) == ends
    names = [one.event for one in done if isinstance(one, Record)]
    assert names == ["node-crashed", *([word] if word else [])]


def test_a_trial_that_fails_ends_in_good_order() -> None:
    nodes = {"a": NodeStatus("starting", 7, policy=HELD), "b": NodeStatus("ready", 8)}
    now = cell(State.WAITING, nodes=nodes, is_again=True, is_trial=True)
    after, done = lives(
        now,
        life.NodeExited(1, "a", exit_of(1), True),
        life.NodeExited(2, "b", Exit(), False),
        life.ChildExited(3, "daemon", exit_of(0)),
    )
    assert Do.ASK_STOP in done
    assert after.state is State.ENDED
    assert after.failure == "node a: exit code 1 before it was ready"
    names = [one.event for one in done if isinstance(one, Record)]
    assert names == ["node-crashed", "node-exited", "reload-failed"]


def test_nodes_that_all_crashed_at_once_run_again() -> None:
    crashes = [life.NodeExited(9, node, exit_of(-9), True) for node in ("a", "b")]
    again = [life.NodeSpawned(10, "a", 70), life.NodeSpawned(10, "b", 80)]
    now, _ = live(*READY, *crashes, *again, life.NodeReady(11, "a"), life.NodeReady(12, "b"))
    assert [node.state for node in now.nodes.values()] == ["running", "running"]


@pytest.mark.parametrize(
    ("events", "cause", "nodes"),
    [
        ((life.Refused(9, "no"),), "refused", ""),
        ((life.StartTimedOut(9, SECOND),), "start-timeout", "a b"),
        ((life.ChildExited(9, "daemon", exit_of(-9)),), "daemon-lost", ""),
        ((life.ConnectionLost(9),), "coordinator-lost", ""),
    ],
)
def test_a_failure_names_its_cause(events: tuple[life.Event, ...], cause: str, nodes: str) -> None:
    _, done = live(*START, *events)
    (failure,) = [one for one in done if isinstance(one, Record) and one.event == "dataflow-failed"]
    assert (failure.details["cause"], failure.details.get("nodes", "")) == (cause, nodes)


def test_a_failed_node_names_itself_and_whom_it_starves() -> None:
    now, _ = live(*READY)
    now = replace(now, downstream={"a": ("b",)})
    said: list[Record] = []
    for event in (
        life.NodeExited(9, "a", exit_of(1), False),
        life.NodeExited(9, "b", Exit(), False),
        life.RunFinished(10),
        life.ResultKnown(11, {"a": exit_of(1), "b": Exit()}),
        life.ChildExited(12, "daemon", exit_of(0)),
    ):
        now, actions = step(now, event)
        said += [one for one in actions if isinstance(one, Record)]
    crash, _, failure = said
    assert crash.details == {"exit": "exit code 1", "downstream": "b"}
    assert (failure.details["cause"], failure.details["nodes"]) == ("node-failed", "a")


def test_each_handler_takes_the_events_of_its_entries() -> None:
    for state, row in TABLE.items():
        for event, handler in row.items():
            taken = get_type_hints(handler)["event"]
            assert issubclass(event, taken), f"{handler.__name__} for {event} in {state}"


@pytest.mark.parametrize(
    ("is_attached", "exit", "status"),
    [
        (False, exit_of(5), RunnerExit.OK),
        (True, exit_of(5), RunnerExit.FAILED_AT_STOP),
        (True, Exit(), RunnerExit.OK),
        (True, exit_of(-15), RunnerExit.OK),
        (True, exit_of(143), RunnerExit.OK),
        (True, exit_of(-9), RunnerExit.FAILED_AT_STOP),
    ],
)
def test_a_node_that_fails_on_the_way_out(
    is_attached: bool, exit: Exit, status: RunnerExit
) -> None:
    """Only `doractl run` fails then; systemd must not call a stop of a service a failure."""
    before = cell(State.LEAVING, stop_by="SIGTERM", is_attached=is_attached)
    late = before.stop_us + before.grace
    nodes = {"a": NodeStatus("stopped", exit=exit, since_us=late), "b": NodeStatus("stopped")}
    after, actions = step(replace(before, nodes=nodes), life.ChildExited(1, "daemon", exit_of(-2)))
    assert (after.exit, Record("dataflow-stopped") in actions) == (status, True)


@pytest.mark.parametrize(("state", "since_us"), [("failed", 20 * SECOND), ("stopped", 7)])
def test_sigterm_that_was_not_dora_s(state: str, since_us: int) -> None:
    before = cell(State.LEAVING, stop_by="SIGTERM", stop_us=1, is_attached=True)
    ended = NodeStatus(state, exit=exit_of(-15), since_us=since_us)
    nodes = {"a": ended, "b": NodeStatus("stopped")}
    after, _ = step(replace(before, nodes=nodes), life.ChildExited(1, "daemon", exit_of(-2)))
    assert after.exit is RunnerExit.FAILED_AT_STOP
