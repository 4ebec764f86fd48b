"""A stop with an order: when each node receives its stop, a signal, or more time."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import (
    Cell,
    Deadline,
    Do,
    EndNode,
    GiveTime,
    NodeAction,
    Record,
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


SPREAD = ("recorder", "camera")
"""The nodes of this class run on the member gpu."""


def head(**changes: object) -> Cell:
    nodes = {
        node: one._replace(pid=0, machine="gpu") if node in SPREAD else one
        for node, one in cell().nodes.items()
    }
    return cell(nodes=nodes, members=("gpu",), **changes)


def member(**changes: object) -> Cell:
    nodes = {node: one for node, one in cell().nodes.items() if node in SPREAD}
    stops = {"recorder": STOPS["recorder"]}
    return cell(nodes=nodes, stops=stops, stop_limit=LIMIT // 2, machine="gpu", **changes)


LOST = life.MachineLost(5, "gpu", "no word for 7s")
HEAD_STOPS = life.HeadStops(1, "SIGTERM", LIMIT)


def test_the_order_holds_across_machines() -> None:
    now, done = after(head(), STOP)
    assert done == [StopNode("camera", GRACE), StopNode("arm", GRACE), StopNode("screen", GRACE)]
    now, done = after(now, exited("arm"), exited("screen"), exited("camera"))
    assert done == [StopNode("recorder", WITHIN)]
    now, done = after(now, exited("recorder"))
    assert done == [StopNode("upload", GRACE)]
    assert step(now, exited("upload"))[0].state is State.LEAVING


@pytest.mark.parametrize("waits", [True, False])
def test_a_lost_machine_leaves_the_others_their_order(waits: bool) -> None:
    """Without the policy no other run follows; with it the same nodes stop."""
    now, actions = step(head(waits_for_lost=waits), LOST)
    assert (now.state, now.reload) == (State.STOPPING, waits)
    assert Do.END_NODES not in actions
    told = [one.node for one in actions if isinstance(one, StopNode)]
    assert told == ["arm", "upload", "screen"], "the recorder is gone with its machine"
    now, _ = after(now, exited("arm"), exited("screen"), exited("upload"))
    assert now.state is State.LEAVING


def test_a_machine_that_is_lost_during_the_stop_holds_nobody_up() -> None:
    now, _ = after(head(), STOP, exited("arm"), exited("screen"))
    now, actions = step(now, LOST)
    assert StopNode("upload", GRACE) in actions
    assert not [one for one in actions if isinstance(one, Deadline)], "the time runs on"
    assert step(now, exited("upload"))[0].state is State.LEAVING


def test_nodes_of_a_part_that_is_stopped_on_its_machine_stop_in_their_turn() -> None:
    stopped = replace(LOST, reason="", by="SIGTERM", is_waiting=True)
    now, done = after(head(), stopped)
    assert StopNode("camera", GRACE) in done
    assert now.exit is RunnerExit.STOPPED_ON_MACHINE
    now, done = after(now, exited("arm"), exited("camera"))
    assert StopNode("recorder", WITHIN) in done


def test_a_member_stops_a_node_when_the_head_says_so() -> None:
    now, actions = step(member(), HEAD_STOPS)
    assert now.state is State.STOPPING
    assert not any(one in actions for one in (Do.ASK_STOP, Do.END_NODES))
    assert not [one for one in actions if isinstance(one, StopNode)]
    turn = life.NodeTurn(2, "recorder", WITHIN)
    now, done = after(now, life.NodeTurn(2, "camera", GRACE), exited("camera"), turn, turn)
    assert done == [StopNode("camera", GRACE), StopNode("recorder", WITHIN)]
    assert format_status(now) == "stopping, waiting for recorder"
    assert after(now, life.NodeTurn(2, "camera", 1), life.NodeTurn(2, "unknown", 1))[1] == []
    now, done = after(now, life.NodeOverdue(3, "recorder"), life.NodeOverdue(3, "recorder"))
    assert done == [EndNode("recorder", after=HALF), EndNode("recorder")]


def test_a_member_keeps_its_daemon_until_the_head_has_stopped_all() -> None:
    now, _ = after(member(), HEAD_STOPS, exited("camera"), exited("recorder"))
    assert now.state is State.STOPPING, "the daemon may have the last messages of the camera"
    now, actions = step(now, life.HeadStops(9, "SIGTERM"))
    assert now.state is State.LEAVING
    assert Do.DISMISS_DAEMON in actions


def test_a_head_that_does_not_wait_any_more_has_its_members_leave() -> None:
    now, actions = step(step(member(), HEAD_STOPS)[0], life.HeadStops(9, "SIGTERM"))
    assert actions == (Deadline(2 * SECOND),)
    assert step(now, life.DeadlinePassed(10))[0].state is State.LEAVING


def test_a_shutdown_of_the_machine_of_a_member_that_stops_is_no_second_request() -> None:
    now = step(member(), HEAD_STOPS)[0]
    now, actions = step(now, STOP)
    assert (now.state, actions) == (State.STOPPING, ())
    assert step(now, STOP)[0].state is State.LEAVING


def test_a_member_that_is_stopped_here_waits_for_the_order() -> None:
    now, actions = step(member(), STOP)
    assert Do.ASK_STOP in actions, "which lets the head know"
    assert Deadline(LIMIT // 2 + 2 * SECOND) in actions
    now, actions = step(now, HEAD_STOPS)
    assert now.awaits_head
    assert actions == (Deadline(LIMIT + 4 * SECOND),)


def test_a_member_without_its_head_gives_its_nodes_their_time() -> None:
    now, actions = step(step(member(), HEAD_STOPS)[0], life.HeadLost(3, "no word for 7s"))
    assert Do.END_NODES in actions
    assert Deadline(LIMIT + 2 * SECOND) in actions
    assert step(now, life.StopAnswered(4))[0].state is State.LEAVING


def test_without_an_order_a_second_word_of_the_head_has_no_effect() -> None:
    now = step(member(), life.HeadStops(1, "SIGTERM"))[0]
    assert step(now, life.HeadStops(2, "SIGTERM")) == (now, ())
