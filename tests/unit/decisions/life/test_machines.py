"""Whole lives of the cells of a dataflow that has several machines."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Deadline, Do, Record, State
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import format_status
from dora_systemd.values import SECOND

HERE = NodeStatus("running", 7)
THERE = NodeStatus("running", 0, machine="gpu")
LOST = life.MachineLost(5, "gpu", "no word for 7s")


def head(state: State, **changes: object) -> Cell:
    nodes = {"here": HERE, "there": THERE}
    cell = Cell(10 * SECOND, 0, nodes, state, members=("gpu",))
    return replace(cell, **changes)  # type: ignore[arg-type]


def member(state: State, **changes: object) -> Cell:
    cell = Cell(10 * SECOND, 0, {"there": HERE}, state, machine="gpu")
    return replace(cell, **changes)  # type: ignore[arg-type]


def events_of(actions: tuple[object, ...]) -> list[str]:
    return [one.event for one in actions if isinstance(one, Record)]


def test_the_head_waits_for_its_members_without_end() -> None:
    cell, actions = step(head(State.JOINING), life.DaemonConnected(1))
    assert cell.state is State.GATHERING
    assert actions == (Do.GATHER, Deadline(None))
    assert format_status(cell) == "waiting for gpu"
    cell, _ = step(cell, life.MachinesAwaited(2, "waiting for machine gpu (ssh: no route)"))
    assert format_status(cell) == "waiting for machine gpu (ssh: no route)"
    cell, actions = step(cell, life.Gathered(3))
    assert cell.state is State.STARTING
    assert Do.SEND_START in actions


def test_a_member_that_is_lost_before_the_run_is_waited_for() -> None:
    cell, actions = step(head(State.GATHERING), life.MachineJoined(1, "gpu"))
    assert events_of(actions) == ["machine-joined"]
    cell, actions = step(cell, LOST)
    assert (cell.state, events_of(actions)) == (State.GATHERING, ["machine-lost"])
    _, actions = step(cell, life.MachineJoined(6, "gpu"))
    assert events_of(actions) == ["machine-back"]


@pytest.mark.parametrize("state", [State.STARTING, State.WAITING, State.RUNNING])
def test_a_lost_machine_ends_the_run_without_dora(state: State) -> None:
    cell, actions = step(head(state), LOST)
    assert cell.state is State.STOPPING
    assert Do.END_NODES in actions
    assert Do.ASK_STOP not in actions
    assert cell.nodes["there"].state == "stopped"
    cell, _ = step(cell, life.NodeExited(6, "here", Exit(), False))
    assert cell.state is State.LEAVING
    cell, actions = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.exit, cell.cause) == (RunnerExit.ENGINE_LOST, Cause.MACHINE_LOST)
    assert cell.failure == "machine gpu: no word for 7s"
    assert events_of(actions) == ["dataflow-failed"]


@pytest.mark.parametrize("state", [State.STARTING, State.WAITING, State.RUNNING])
def test_with_a_restart_policy_the_next_run_waits_for_the_machine(state: State) -> None:
    """In the same process: a restart by systemd would use up one."""
    cell, actions = step(head(state, waits_for_lost=True), LOST)
    assert (cell.state, events_of(actions)) == (State.STOPPING, ["machine-lost"])
    assert Do.END_NODES in actions
    cell, _ = step(cell, life.StopAnswered(6))
    cell, actions = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.state, cell.reload, cell.exit) == (State.ENDED, True, RunnerExit.OK)
    assert (*cell.lost, *events_of(actions)) == ("gpu",)
    _, actions = step(head(State.GATHERING, lost=frozenset({"gpu"})), life.MachineJoined(8, "gpu"))
    assert events_of(actions) == ["machine-back"]


def test_a_port_that_is_taken_there_is_no_failure() -> None:
    cell, _ = step(head(State.GATHERING), life.ReloadAsked(1))
    cell, actions = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.state, cell.reload, events_of(actions)) == (State.ENDED, True, [])


def test_the_failure_of_a_part_is_one_of_the_dataflow_whatever_the_policy() -> None:
    failed = replace(LOST, reason="the dora daemon is gone (signal SIGKILL)", is_failure=True)
    cell, _ = step(head(State.RUNNING, waits_for_lost=True), failed)
    cell, _ = step(cell, life.StopAnswered(6))
    cell, actions = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.reload, cell.exit) == (False, RunnerExit.ENGINE_LOST)
    assert events_of(actions) == ["dataflow-failed"]


def test_a_stop_while_a_lost_machine_ends_the_run_is_a_stop() -> None:
    cell, _ = step(head(State.RUNNING, waits_for_lost=True), LOST)
    cell, _ = step(cell, life.StopAsked(6, "SIGTERM"))
    cell, _ = step(cell, life.StopAnswered(7))
    cell, actions = step(cell, life.ChildExited(8, "daemon", Exit()))
    assert (cell.reload, cell.exit) == (False, RunnerExit.OK)
    assert events_of(actions) == ["dataflow-stopped"]


def test_who_stops_a_member_stops_the_dataflow() -> None:
    cell, _ = step(head(State.RUNNING), life.MachineLost(5, "gpu", "", by="SIGTERM"))
    cell, _ = step(cell, life.StopAnswered(6))
    cell, _ = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.exit, cell.cause) == (RunnerExit.STOPPED_ON_MACHINE, Cause.STOPPED_ON_MACHINE)
    assert cell.failure == "it was stopped on machine gpu by SIGTERM"


def test_who_stops_a_member_before_the_run_stops_the_dataflow() -> None:
    """Its link would only start it again."""
    cell, actions = step(head(State.GATHERING), life.MachineLost(5, "gpu", "bye", by="SIGTERM"))
    assert (cell.exit, cell.cause) == (RunnerExit.STOPPED_ON_MACHINE, Cause.STOPPED_ON_MACHINE)
    assert cell.failure == "it was stopped on machine gpu by SIGTERM"
    assert Record("machine-lost", "", {"machine": "gpu", "reason": "bye"}) in actions
    assert cell.state is not State.GATHERING


def test_a_machine_that_is_lost_while_dora_stops_is_not_waited_for() -> None:
    cell, actions = step(head(State.RUNNING), life.StopAsked(1, "SIGTERM"))
    assert Do.ASK_STOP in actions
    cell, actions = step(cell, LOST)
    assert Do.END_NODES in actions
    cell, _ = step(cell, life.StopAnswered(6))
    cell, actions = step(cell, life.ChildExited(7, "daemon", Exit()))
    assert (cell.exit, events_of(actions)) == (RunnerExit.OK, ["dataflow-stopped"])


def test_a_machine_without_nodes_may_leave_while_dora_stops_the_others() -> None:
    cell, _ = step(head(State.RUNNING), life.StopAsked(1, "SIGTERM"))
    cell, _ = step(cell, life.NodeExited(2, "there", Exit(), False))
    assert step(cell, LOST) == (cell, ())


def test_a_machine_that_refuses_is_no_reason_for_a_restart() -> None:
    refused = life.Refused(1, "machine gpu: no doractl", Cause.MACHINE_REFUSES)
    assert step(head(State.GATHERING), refused)[0].exit is RunnerExit.BAD_DATAFLOW
    absent = life.Refused(1, "machine gpu: has not joined", Cause.NO_MACHINE)
    assert step(head(State.GATHERING), absent)[0].exit is RunnerExit.NO_MACHINE


def test_a_member_finds_the_run_of_the_head() -> None:
    cell, _ = step(member(State.JOINING), life.DaemonConnected(1))
    assert (cell.state, format_status(cell)) == (State.GATHERING, "waiting for the head")
    cell, actions = step(cell, life.RunStarted(2, "run"))
    assert (cell.state, cell.run) == (State.STARTING, "run")
    assert Do.SUBSCRIBE in actions


def test_a_member_that_nobody_speaks_to_fails() -> None:
    cell, _ = step(member(State.BOOTING), life.DeadlinePassed(1))
    assert cell.failure == "no head has said what to run within 30 s"


@pytest.mark.parametrize("state", [State.BOOTING, State.JOINING, State.GATHERING])
def test_a_member_without_a_head_ends_at_once_if_nothing_runs(state: State) -> None:
    cell, actions = step(member(state), life.HeadLost(1, "no word for 7s"))
    assert (cell.state, cell.exit) == (State.ENDED, RunnerExit.OK)
    assert events_of(actions) == ["dataflow-stopping", "dataflow-stopped"]


@pytest.mark.parametrize("state", [State.STARTING, State.WAITING, State.RUNNING, State.STOPPING])
def test_a_member_without_a_head_ends_its_nodes(state: State) -> None:
    cell, actions = step(member(state), life.HeadLost(1, "no word for 7s"))
    assert cell.state is State.STOPPING
    assert Do.END_NODES in actions
    cell, _ = step(cell, life.StopAnswered(2))
    cell, _ = step(cell, life.DeadlinePassed(3))
    assert (cell.state, cell.exit) == (State.ENDED, RunnerExit.OK)


def test_a_member_does_not_ask_dora_to_stop() -> None:
    cell, actions = step(member(State.RUNNING), life.HeadStops(1, "SIGTERM"))
    assert cell.state is State.STOPPING
    assert not any(one in actions for one in (Do.ASK_STOP, Do.END_NODES))
    cell, _ = step(cell, life.NodeExited(2, "there", Exit(), False))
    cell, actions = step(cell, life.ChildExited(3, "daemon", Exit()))
    assert events_of(actions) == ["dataflow-stopped"]
