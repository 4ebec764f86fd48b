"""`doractl reset`: systemd forgets failures and counts restarts anew."""

from collections.abc import Sequence

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.stop import Outcome

_FACTS = ("NRestarts",)


def reset_cells(manager: Manager, cells: Sequence[Cell]) -> list[Outcome]:
    """Clear the restarts used up by each dataflow, and its failure; what runs goes on running.

    A failed unit that nothing else holds is gone from systemd then, its logs stay.
    """
    return [_reset(manager, cell) for cell in cells]


def _reset(manager: Manager, cell: Cell) -> Outcome:
    used = manager.read(cell.unit, _FACTS)["NRestarts"]
    manager.reset_failed(cell.unit)
    return Outcome(
        cell, f"Dataflow reset: {cell.uuid} ({cell.name}, restart counter reset, was {used})"
    )
