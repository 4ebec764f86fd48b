"""Nodes that wait for what they need: the live table, the start timeout, and what is shown."""

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.restarts import LATCH_KEYS
from dora_systemd.decisions.cell.status import LATCHED, UNMET, CellStatus, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Record, State
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import cell_status, format_status, initial_nodes, stage
from dora_systemd.values import SECOND

GONE = "/dev/video0 (not there)"
CAMERA = NodeStatus("running", 7, policy=LATCHED, since_us=1)


def cell_of(state: State, **nodes: NodeStatus) -> Cell:
    ready_us = 1 if state is State.RUNNING else 0
    return Cell(10 * SECOND, 1, nodes, state, run="r", ready_us=ready_us)


def after(cell: Cell, *events: life.Event) -> tuple[Cell, list[str]]:
    """The cell after these events, and the names of the recorded ones."""
    names: list[str] = []
    for event in events:
        cell, actions = step(cell, event)
        names += [one.event for one in actions if isinstance(one, Record)]
    return cell, names


def test_unplugged_and_plugged_in_again() -> None:
    cell = cell_of(State.RUNNING, camera=CAMERA, sink=NodeStatus("running", 8))
    cell, names = after(cell, life.NodeLacks(2 * SECOND, "camera", GONE))
    assert stage(cell) == UNMET
    assert format_status(cell) == (
        f"1/2 nodes running; camera waits for {GONE} since 1970-01-01 00:00:02 UTC"
    )
    cell, more = after(
        cell,
        life.NodeExited(3, "camera", exit_of(1), True),
        life.NodeSpawned(4, "camera", 9),
        life.NodeLacks(5, "camera", "/dev/video0 (no permission to read it)"),
    )
    node = cell.nodes["camera"]
    assert (node.state, node.pid, node.since_us, node.restarts) == ("waiting", 9, 2 * SECOND, 0)
    cell, most = after(
        cell, life.NodeMet(65 * SECOND, "camera"), life.NodeReady(66 * SECOND, "camera")
    )
    assert [*names, *more, *most] == ["node-waiting", "node-needs-met", "node-ready"]
    assert (stage(cell), cell.nodes["camera"].needs) == ("running", "")


def test_a_node_that_was_restarted_before_its_device_was_missed_has_all_restarts() -> None:
    cell = cell_of(State.RUNNING, camera=CAMERA._replace(policy="on-failure", restarts=2))
    cell, names = after(cell, life.NodeLacks(2, "camera", GONE), life.NodeMet(3, "camera"))
    assert (cell.nodes["camera"].restarts, cell.nodes["camera"].state) == (0, "starting")
    assert names == ["node-waiting", "node-needs-met"]


def test_a_start_that_waits_for_needs_alone_counts_as_started() -> None:
    waiting = NodeStatus("waiting", 7, needs=GONE)
    busy = cell_of(State.WAITING, camera=waiting, sink=NodeStatus("starting", 8))
    assert stage(busy) == "waiting"
    cell, _ = after(busy, life.NodeReady(2, "sink"))
    assert stage(cell) == UNMET
    table = cell_status(cell, "", (), {}, {})
    assert CellStatus.from_json(table.to_json()).nodes["camera"].needs == GONE


def test_the_start_timeout_does_not_run_meanwhile() -> None:
    waiting = cell_of(State.WAITING, camera=NodeStatus("waiting", 7, needs=GONE))
    late = life.StartTimedOut(1, SECOND)
    cell, _ = after(waiting, late)
    assert cell.state is State.WAITING
    cell, _ = after(cell, life.NodeMet(2 * SECOND, "camera"), late)
    assert cell.state is State.WAITING  # that timeout began before the wait
    cell, names = after(cell, life.StartTimedOut(2 * SECOND, SECOND))
    assert cell.state is State.ENDED
    assert names == ["dataflow-failed"]


def test_a_node_without_restarts_is_started_once_more_only_to_be_given_up() -> None:
    cell = cell_of(State.RUNNING, camera=CAMERA)
    cell, names = after(
        cell,
        life.NodeExited(2, "camera", exit_of(3), True),
        life.NodeSpawned(3, "camera", 9),
        life.NodeExited(4, "camera", exit_of(3), False),
    )
    node = cell.nodes["camera"]
    assert (node.state, node.policy, node.restarts, node.pid) == ("failed", "never", 0, 0)
    assert names == ["node-crashed"]


def test_a_node_without_restarts_that_fails_before_the_start_fails_the_start() -> None:
    cell = cell_of(State.WAITING, camera=CAMERA._replace(state="starting"))
    cell, names = after(cell, life.NodeExited(2, "camera", exit_of(3), True))
    assert cell.failure == "node camera: exit code 3 before it was ready"
    assert names == ["node-crashed", "dataflow-failed"]


def test_a_reload_of_a_waiting_node_lets_it_wait() -> None:
    waiting = NodeStatus("waiting", 7, needs=GONE, since_us=1)
    cell = cell_of(State.RUNNING, camera=waiting)
    cell, _ = after(cell, life.NodeReloading(2, "camera", NodeStatus(kind="python")))
    assert cell.nodes["camera"] == waiting._replace(kind="python")


@pytest.mark.parametrize("state", [State.STOPPING, State.LEAVING, State.ENDED])
def test_needs_mean_nothing_at_the_end(state: State) -> None:
    cell = cell_of(state, camera=CAMERA)
    assert after(cell, life.NodeLacks(2, "camera", GONE), life.NodeMet(3, "camera")) == (cell, [])


def test_a_waiting_node_stops_as_others_do() -> None:
    cell = cell_of(State.RUNNING, camera=NodeStatus("waiting", 9, needs=GONE))
    cell, _ = after(cell, life.StopAsked(2, "SIGTERM"))
    assert cell.state is State.STOPPING
    cell, names = after(cell, life.NodeExited(3, "camera", exit_of(0), False))
    assert cell.state is State.LEAVING
    assert names == ["node-exited"]


def test_the_policy_of_such_a_node_is_known_by_its_delay() -> None:
    raw = {"id": "camera", **LATCH_KEYS}
    node = initial_nodes({"camera": "python"}, {"nodes": [raw]}, 1)["camera"]
    assert (node.policy, node.max_restarts) == (LATCHED, 0)


def test_a_silent_node_that_loses_its_device_is_watched_again() -> None:
    cell = cell_of(State.RUNNING, camera=CAMERA)
    silent = life.NodeSilent(1, "camera", "image", "no image for 2s", "restart", "no image for 2s")
    cell, _ = after(
        cell,
        silent,
        life.NodeLacks(2, "camera", GONE),
        life.NodeExited(3, "camera", exit_of(0), True),
        life.NodeMet(4, "camera"),
    )
    node = cell.nodes["camera"]
    assert (node.state, node.silent, node.is_ended, node.hung) == ("starting", "", False, "")
