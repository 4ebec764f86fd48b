"""Counts the automatic restarts of a dataflow by systemd that have happened."""

from dora_systemd.adapters.bus.manager import SETTLED, Manager
from dora_systemd.decisions.life.states import RunnerExit
from dora_systemd.verbs.facts.cells import Cell


def read_restarts(manager: Manager, cell: Cell) -> int:
    """Ask systemd how often it has restarted the unit of a dataflow."""
    counted = int(manager.read(cell.unit, ["NRestarts"])["NRestarts"])
    return without_refused(manager, cell, counted)


def without_refused(manager: Manager, cell: Cell, counted: int) -> int:
    """The restarts that have happened. counted: NRestarts=.

    NRestarts= counts the restart that the runner has refused, too, because no restart was left.
    """
    if not counted or cell.state.active in SETTLED:
        return counted
    status = manager.read(cell.unit, ["ExecMainStatus"])["ExecMainStatus"]
    return counted - 1 if status == RunnerExit.RESTARTS_SPENT else counted
