"""STATUS= lines, whole."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import UNMET, CellStatus, NodeStatus
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.view import cell_status, format_status, initial_nodes, stage
from dora_systemd.decisions.resources.usage import LineCount
from dora_systemd.decisions.views.stages import stage_of_text
from dora_systemd.decisions.watchdog.messages import Sign


def cell(state: State, **states: str) -> Cell:
    nodes = {ident: NodeStatus(text) for ident, text in states.items()}
    return Cell(0, 0, nodes, state)


def test_status_lines() -> None:
    lines = [
        (cell(State.BOOTING), "starting the dora coordinator"),
        (cell(State.JOINING), "starting the dora daemon"),
        (cell(State.STARTING), "starting the nodes"),
        (
            cell(State.WAITING, a="ready", b="starting", c="starting"),
            "1/3 nodes ready, waiting for b, c",
        ),
        (cell(State.RUNNING, a="running", b="dynamic"), "2/2 nodes running"),
        (cell(State.RUNNING, a="running", b="finished"), "1/2 nodes running; finished: b"),
        (
            replace(cell(State.STOPPING, a="running", b="stopped"), grace=10_000_000),
            "stopping, waiting for a (killed if not ended within 15s)",
        ),
        (cell(State.STOPPING, a="stopped"), "stopping"),
        (cell(State.CLOSING), "asking dora how the dataflow ended"),
        (cell(State.LEAVING), "stopping the dora daemon"),
        (cell(State.ENDED), "finished"),
        (replace(cell(State.ENDED), stop_by="SIGTERM"), "stopped"),
        (replace(cell(State.ENDED), failure="node a: exit code 1"), "failed: node a: exit code 1"),
    ]
    for one, expected in lines:
        assert format_status(one) == expected


def test_the_stage_is_in_the_status_line() -> None:
    """Another user reads it there: the table is the dataflow's own."""
    silent = Cell(0, 0, {"a": NodeStatus("running", silent="nothing came")}, State.RUNNING)
    lacks = {"a": NodeStatus("running"), "b": NodeStatus("waiting", needs="/dev/video0")}
    unmet = Cell(0, 0, lacks, State.RUNNING)
    shown = {
        "degraded": [
            cell(State.RUNNING, a="running", b="failed"),
            cell(State.RUNNING, a="restarting", b="failed", c="finished"),
            silent,
        ],
        UNMET: [unmet],
        "stopping": [cell(State.STOPPING, a="running"), cell(State.LEAVING)],
        "gathering": [replace(cell(State.GATHERING), machine="gpu")],
    }
    for name, cells in shown.items():
        for one in cells:
            assert (stage_of_text(format_status(one)), stage(one)) == (name, name)
    for one in (cell(State.RUNNING, a="running", b="finished"), cell(State.WAITING, a="failed")):
        assert stage_of_text(format_status(one)) == "starting"


@pytest.mark.parametrize(("more", "end"), [(0, ""), (1, " and 1 more"), (2, " and 2 more")])
def test_failures_are_named_and_many_are_counted(more: int, end: str) -> None:
    nodes = {f"n{i}": NodeStatus("failed", exit=exit_of(1)) for i in range(5 + more)}
    text = format_status(Cell(0, 0, nodes, State.RUNNING))
    assert text.startswith(f"0/{5 + more} nodes running; failed: n0 (exit code 1), ")
    assert text.endswith(f"n4 (exit code 1){end}")


def test_stages_and_table() -> None:
    assert stage(cell(State.RUNNING, a="running")) == "running"
    assert stage(cell(State.RUNNING, a="failed")) == "degraded"
    assert stage(cell(State.ENDED)) == "ended"
    raw = [{"id": "a", "restart_policy": "always", "max_restarts": 3}, {"id": "b"}]
    nodes = initial_nodes({"a": "python", "b": "dynamic"}, {"nodes": raw}, 5)
    assert [node.state for node in nodes.values()] == ["starting", "dynamic"]
    assert [node.policy for node in nodes.values()] == ["always", "never"]
    assert [node.max_restarts for node in nodes.values()] == [3, 0]
    table = cell_status(Cell(0, 3, nodes), "uuid", (), {"a": LineCount(3)}, {"a": Sign("up")})
    assert CellStatus.from_json(table.to_json()) == table
