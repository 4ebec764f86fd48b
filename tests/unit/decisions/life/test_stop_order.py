"""A stop with an order: when each node receives its stop, a signal, or more time."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import (
    Cell,
    Deadline,
    Do,
    EndNode,
    GiveTime,
    NodeAction,
    Record,
    RunnerExit,
    State,
    StopNode,
)
from dora_systemd.decisions.life.stop_order import in_turn
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import format_status
from dora_systemd.values import INFINITY, SECOND

GRACE, WITHIN, LIMIT = 10 * SECOND, 60 * SECOND, 200 * SECOND
HALF = GRACE // 2
STOPS = {
    "recorder": NodeStop("recorder", WITHIN, ("camera", "arm")),
    "upload": NodeStop("upload", 0, ("recorder",)),
}
NODES = ("recorder", "camera", "arm", "upload", "screen")
STOP = life.StopAsked(1, "SIGTERM")


def cell(**changes: object) -> Cell:
    nodes = {node: NodeStatus("running", pid) for pid, node in enumerate(NODES, 7)}
    now = Cell(GRACE, 0, nodes, State.RUNNING, ready_us=1, stops=STOPS, stop_limit=LIMIT)
    return replace(now, **changes)  # type: ignore[arg-type]


def after(now: Cell, *events: life.Event) -> tuple[Cell, list[NodeAction]]:
    """The cell after the events, and what was done for single nodes."""
    done: list[NodeAction] = []
    for event in events:
        now, actions = step(now, event)
        done += [one for one in actions if isinstance(one, StopNode | EndNode | GiveTime)]
    return now, done


def exited(node: str, exit: Exit | None = None) -> life.NodeExited:
    return life.NodeExited(2, node, exit or Exit(), will_restart=False)


def test_first_those_that_wait_for_nobody() -> None:
    now, actions = step(cell(), STOP)
    assert now.state is State.STOPPING
    assert [one for one in actions if isinstance(one, StopNode)] == [
        StopNode("camera", GRACE),
        StopNode("arm", GRACE),
        StopNode("screen", GRACE),
    ]
    assert Do.ASK_STOP not in actions
    assert Deadline(LIMIT + 2 * SECOND) in actions
    assert in_turn(now) == (["camera", "arm", "screen"], ["recorder", "upload"])


def test_each_is_told_when_the_last_one_before_it_has_ended() -> None:
    now, done = after(cell(), STOP, exited("screen"), exited("camera"))
    assert StopNode("recorder", WITHIN) not in done
    now, done = after(now, exited("arm"))
    assert done == [StopNode("recorder", WITHIN)]
    now, done = after(now, exited("recorder"))
    assert done == [StopNode("upload", GRACE)]
    now, actions = step(now, exited("upload"))
    assert now.state is State.LEAVING
    assert Do.DISMISS_DAEMON in actions
    assert step(now, life.DeadlinePassed(3))[0].exit is RunnerExit.OK


def test_a_node_that_ended_before_is_not_waited_for() -> None:
    nodes = {**cell().nodes, "camera": NodeStatus("failed"), "arm": NodeStatus("restarting")}
    _, done = after(cell(nodes=nodes), STOP)
    told = [one.node for one in done if isinstance(one, StopNode)]
    assert told == ["recorder", "arm", "screen"], "arm waits for its restart, which dora cancels"


def test_without_the_setting_and_before_all_are_ready_dora_stops_them() -> None:
    for now in (cell(stops={}), cell(ready_us=0), cell(ready_us=0, state=State.WAITING)):
        stopped, actions = step(now, STOP)
        assert stopped.state is State.STOPPING
        assert Do.ASK_STOP in actions
        assert not [one for one in actions if isinstance(one, StopNode)]
        assert after(stopped, exited("camera"), exited("arm"))[1] == []


@pytest.mark.parametrize(
    "event",
    [
        life.ReloadAsked(1),
        life.NodeSilent(1, "camera", "image", "no image for 2s", "fail", "no image for 2s"),
        life.NodeExited(1, "camera", exit_of(1), will_restart=False, is_essential=True),
    ],
)
def test_whatever_ends_the_dataflow_keeps_the_order(event: life.Event) -> None:
    now, done = after(cell(notice="x"), event)
    assert now.state is State.STOPPING
    told = [one.node for one in done if isinstance(one, StopNode)]
    assert "arm" in told
    assert not {"recorder", "upload"} & {*told}


def test_a_node_that_does_not_end_gets_sigterm_then_sigkill() -> None:
    now, _ = after(cell(), STOP, exited("arm"))
    assert Record("node-stop-late", "camera") in step(now, life.NodeOverdue(1, "camera"))[1]
    now, done = after(now, life.NodeOverdue(1, "camera"))
    assert done == [EndNode("camera", after=HALF)]
    now, done = after(now, life.NodeOverdue(1, "camera"))
    assert done == [EndNode("camera"), StopNode("recorder", WITHIN)], "the next one need not wait"
    assert after(now, life.NodeOverdue(1, "camera"))[1] == []


def test_who_has_ended_is_not_late() -> None:
    now, _ = after(cell(), STOP, exited("arm"))
    for node in ("arm", "upload", "unknown"):
        assert after(now, life.NodeOverdue(1, node)) == (now, [])


def test_more_time_leaves_the_others_theirs() -> None:
    now, _ = after(cell(), STOP, exited("arm"), exited("camera"))
    passed = 20 * SECOND
    ask = life.NodeExtends(1, "recorder", 30 * SECOND, passed)
    assert after(now, ask)[1] == [GiveTime("recorder", 30 * SECOND)]
    ask = replace(ask, wanted=INFINITY)
    left = LIMIT - passed - HALF - (GRACE + HALF)  # upload comes after it
    assert after(now, ask)[1] == [GiveTime("recorder", left)]
    assert after(now, replace(ask, passed_us=passed + left))[1] == []


def test_who_gets_no_more_time() -> None:
    now, _ = after(cell(), STOP)
    for node in ("recorder", "camera", "unknown"):  # not told yet, no time of its own, no node
        assert after(now, life.NodeExtends(1, node, SECOND, 0))[1] == []
    now, _ = after(now, exited("arm"), exited("camera"), life.NodeOverdue(1, "recorder"))
    assert after(now, life.NodeExtends(1, "recorder", SECOND, 0))[1] == [], "SIGTERM was sent"


def test_a_second_request_ends_it_at_once() -> None:
    now, _ = after(cell(), STOP)
    now, actions = step(now, STOP)
    assert now.state is State.LEAVING
    assert Do.DISMISS_DAEMON in actions


@pytest.mark.parametrize("was_late", [True, False])
def test_a_node_that_sigterm_ended_after_its_time_is_no_failure(was_late: bool) -> None:
    now, _ = after(cell(is_attached=True), STOP)
    late = [life.NodeOverdue(1, "camera")] if was_late else []
    now, _ = after(now, *late, exited("camera", exit_of(-15)))
    rest = [exited(node) for node in ("arm", "screen", "recorder", "upload")]
    now, _ = after(now, *rest, life.DeadlinePassed(3))
    assert now.exit is (RunnerExit.OK if was_late else RunnerExit.FAILED_AT_STOP)


def test_its_status_names_who_comes_when() -> None:
    now, _ = after(cell(), STOP)
    assert format_status(now) == (
        "stopping, waiting for camera, arm, screen, then recorder, upload"
    )
    now, _ = after(now, *[exited(node) for node in ("camera", "arm", "screen", "recorder")])
    assert format_status(now) == "stopping, waiting for upload"
