"""Which nodes are given up: those that stay down while the others run, and no others."""

from dataclasses import replace

import pytest

from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.life.given_up import given_up
from dora_systemd.decisions.life.states import Cell, State

CRASHED = exit_of(1)
UP = NodeStatus("running", 7)
DOWN = NodeStatus("failed", exit=CRASHED, policy="never")


def cell(node: NodeStatus, **changes: object) -> Cell:
    table = {"a": node, "b": UP}
    return replace(Cell(0, 0, table, state=State.RUNNING), **changes)  # type: ignore[arg-type]


def test_a_node_that_has_failed() -> None:
    assert given_up(cell(UP), cell(DOWN)) == {"a": "exit code 1"}


def test_a_node_without_restarts_left() -> None:
    spent = DOWN._replace(policy="on-failure", restarts=3)
    assert given_up(cell(UP), cell(spent)) == {"a": "exit code 1 after 3 restarts"}


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (cell(DOWN), cell(DOWN)),
        (cell(UP), cell(UP)),
        (cell(UP), cell(DOWN._replace(policy=HELD))),
        (cell(UP), cell(DOWN._replace(state="restarting"))),
        (cell(UP), cell(DOWN._replace(state="stopped"))),
        (cell(UP), cell(DOWN._replace(exit=Exit(by="b")))),
        (cell(UP), cell(DOWN, failure="node a: exit code 1")),
        (cell(UP), cell(DOWN, stop_by="SIGTERM")),
        (cell(UP), cell(DOWN, reload=True)),
        (cell(UP), cell(DOWN, state=State.STOPPING)),
        # The reload is undone: the version before it comes back.
        (cell(NodeStatus("starting", 7)), cell(DOWN)),
    ],
)
def test_other_ends(before: Cell, after: Cell) -> None:
    assert given_up(before, after) == {}
