"""`doractl reset`: clears failures and restart counters in systemd."""

from collections.abc import Sequence

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.stop import Outcome

_FACTS = ("NRestarts",)


def reset_cells(manager: Manager, cells: Sequence[Cell]) -> list[Outcome]:
    """Clear the restart counter and the failure of each dataflow; running ones keep running.

    systemd then unloads a failed unit that nothing else references; its logs stay.
    """
    return [_reset(manager, cell) for cell in cells]


def _reset(manager: Manager, cell: Cell) -> Outcome:
    used = manager.read(cell.unit, _FACTS)["NRestarts"]
    manager.reset_failed(cell.unit)
    return Outcome(
        cell, f"Dataflow reset: {cell.uuid} ({cell.name}, restart counter reset, was {used})"
    )
