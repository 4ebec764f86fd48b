"""The failure of an essential node ends the dataflow, and by which exit status."""

from dataclasses import replace
from typing import Any

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import HELD, LATCHED, RESTART, STOP, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Do, Record, State
from dora_systemd.decisions.life.table import step


def running(**of_a: Any) -> Cell:
    nodes = {"a": NodeStatus("running", 7, **of_a), "b": NodeStatus("running", 8)}
    return Cell(10, 0, nodes, State.RUNNING)


def exited(node: str, *, again: bool = False, number: int = 1, **more: Any) -> life.NodeExited:
    how = exit_of(number) if number else Exit()
    return life.NodeExited(1, node, how, again, is_essential=True, **more)


def live(cell: Cell, *events: life.Event) -> tuple[Cell, list[Any]]:
    done: list[Any] = []
    for event in events:
        cell, actions = step(cell, event)
        done += actions
    return cell, done


def records(actions: list[Any]) -> list[str]:
    return [f"{one.event} {one.node}".strip() for one in actions if isinstance(one, Record)]


@pytest.mark.parametrize(
    ("of_a", "reason", "code"),
    [
        ({}, "essential node a: exit code 1", RunnerExit.FAILED),
        (
            {"policy": "on-failure", "max_restarts": 2, "restarts": 2},
            "essential node a: exit code 1 after 2 restarts",
            RunnerExit.NODES_FAILED,
        ),
    ],
)
def test_the_others_are_stopped_and_the_dataflow_has_failed(
    of_a: dict[str, Any], reason: str, code: RunnerExit
) -> None:
    cell, actions = live(running(**of_a), exited("a"))
    assert cell.state is State.STOPPING
    assert Do.ASK_STOP in actions
    assert records(actions) == ["node-crashed a"]
    stopped = life.NodeExited(2, "b", exit_of(-9), False)
    gone = life.ChildExited(3, "daemon", Exit())
    cell, actions = live(cell, stopped, life.StopAnswered(2), gone)
    assert (cell.state, cell.failure, cell.exit) == (State.ENDED, reason, code)
    assert cell.nodes["b"].state == "stopped", "how it ended on our request is no failure"
    assert records(actions) == ["node-exited b", "dataflow-failed"]
    details = next(one.details for one in actions if isinstance(one, Record) and not one.node)
    assert details == {"reason": reason, "cause": "node-failed", "nodes": "a"}


@pytest.mark.parametrize(
    ("of_a", "event"),
    [
        ({"policy": "on-failure"}, exited("a", again=True)),
        ({"policy": HELD}, exited("a", again=True)),
        ({"policy": LATCHED}, exited("a", again=True)),
        ({}, exited("a", number=0)),
        ({}, exited("a", is_stale=True)),
        ({}, exited("unknown", is_stale=True)),
        ({}, life.NodeExited(1, "a", exit_of(1), False)),
    ],
    ids=["restarted", "held", "latched", "finished", "stale", "unknown", "not essential"],
)
def test_what_ends_nothing(of_a: dict[str, Any], event: life.NodeExited) -> None:
    cell, _ = live(running(**of_a), event)
    assert (cell.state, cell.failure) == (State.RUNNING, "")


def asked(what: str) -> life.NodeAsked:
    return life.NodeAsked(0, "a", what, "root (doractl node)")


@pytest.mark.parametrize("what", [STOP, RESTART])
@pytest.mark.parametrize("number", [0, 1, 143, -9, -15])
@pytest.mark.parametrize("state", ["running", "waiting"])
def test_an_end_that_somebody_asks_for_ends_nothing(what: str, number: int, state: str) -> None:
    """Whether it runs or waits for a device, in any exit status; a stopped one stays stopped."""
    nodes = {**running().nodes, "a": NodeStatus(state, 7)}
    cell, actions = live(replace(running(), nodes=nodes), asked(what), exited("a", number=number))
    assert (cell.state, cell.failure) == (State.RUNNING, "")
    assert "node-crashed a" not in records(actions)
    assert (cell.nodes["a"].state == "stopped") is (what == STOP)


@pytest.mark.parametrize("is_stopped_before", [False, True])
def test_a_process_after_an_asked_restart_is_not_taken_back(is_stopped_before: bool) -> None:
    """Nothing goes back to another version: the dataflow is without a node that it needs."""
    before = [asked(STOP), exited("a")] if is_stopped_before else []
    after = [asked(RESTART)] if is_stopped_before else [asked(RESTART), exited("a")]
    cell, _ = live(running(), *before, *after, life.NodeSpawned(1, "a", 9))
    assert (cell.state, cell.failure) == (State.RUNNING, "")
    cell, _ = live(cell, exited("a"))
    assert (cell.state, cell.failure) == (State.STOPPING, "essential node a: exit code 1")


@pytest.mark.parametrize(("restarts", "is_ended"), [(0, False), (1, True)])
def test_a_new_version_that_fails_is_taken_back_by_the_reloader(
    restarts: int, is_ended: bool
) -> None:
    """Only the first process after a reload; dora's restarts of it count as always."""
    reloaded = NodeStatus("starting", 9, restarts=restarts, policy="on-failure", max_restarts=1)
    cell, _ = live(replace(running(), nodes={**running().nodes, "a": reloaded}), exited("a"))
    assert cell.nodes["a"].state == "failed"
    assert bool(cell.failure) is is_ended


def test_a_node_that_lacked_nothing_is_given_up() -> None:
    """Its launcher exits in its place, as the needs of the node decide."""
    latched = running(policy=LATCHED)
    cell, _ = live(latched, exited("a", again=True), life.NodeSpawned(2, "a", 9))
    assert (cell.state, cell.failure) == (State.RUNNING, "")
    cell, _ = live(cell, exited("a"))
    assert (cell.state, cell.failure) == (State.STOPPING, "essential node a: exit code 1")


@pytest.mark.parametrize(
    ("of_a", "essential", "is_ended"),
    [
        ({"state": "failed", "exit": exit_of(1)}, ("b", "a"), True),
        ({"state": "failed", "exit": exit_of(1)}, ("b",), False),
        ({"state": "failed", "exit": exit_of(1), "policy": HELD}, ("a",), False),
        ({"state": "running"}, ("a", "unknown"), False),
    ],
    ids=["failed", "not essential", "held", "old version"],
)
def test_a_failed_reload_ends_it_only_if_the_node_is_down(
    of_a: dict[str, Any], essential: tuple[str, ...], is_ended: bool
) -> None:
    nodes = {**running().nodes, "a": NodeStatus(**of_a)}
    noted = life.ReloadNoted(2, "not reloaded: node a: exit code 1", essential=essential)
    cell, _ = live(replace(running(), nodes=nodes), noted)
    assert (cell.state is State.STOPPING) is is_ended
    assert cell.failure == ("essential node a: exit code 1" if is_ended else "")


def test_a_new_version_that_fails_after_the_reload_was_given_up() -> None:
    late = life.ReloadNoted(2, "not reloaded: node a: not ready within 30s", essential=("a",))
    nodes = {**running().nodes, "a": NodeStatus("starting", 9)}
    cell, _ = live(replace(running(), nodes=nodes), late)
    assert cell.state is State.RUNNING
    again, _ = live(cell, life.NodeReloading(3, "a"), life.NodeSpawned(4, "a", 10), exited("a"))
    assert (again.state, again.notice) == (State.RUNNING, ""), "the next reload is not over"
    cell, _ = live(cell, exited("a"))
    assert (cell.state, cell.failure) == (State.STOPPING, "essential node a: exit code 1")


def test_a_stop_meanwhile_is_a_stop() -> None:
    stop = life.StopAsked(2, "SIGTERM")
    cell, actions = live(running(), exited("a"), stop, life.StopAnswered(3))
    cell, actions = live(cell, life.ChildExited(3, "daemon", Exit()))
    assert (cell.state, cell.exit) == (State.ENDED, RunnerExit.OK)
    assert records(actions) == ["dataflow-stopped"]


def test_the_last_node_needs_no_stop() -> None:
    nodes = {"a": NodeStatus("running", 7)}
    cell, actions = live(Cell(10, 0, nodes, State.RUNNING), exited("a"))
    assert cell.state is State.LEAVING
    assert Do.DISMISS_DAEMON in actions
    cell, _ = live(cell, life.ChildExited(3, "daemon", Exit()))
    assert cell.failure == "essential node a: exit code 1"
