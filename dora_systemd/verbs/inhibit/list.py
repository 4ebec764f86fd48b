"""`doractl inhibit` without arguments: all locks."""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.inhibitors import Inhibited
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.locks import read_holders


def inhibited_dataflows(manager: Manager, scope: Scope) -> list[Inhibited]:
    """The dataflows whose restart is inhibited, by name."""
    cells = {cell.name: cell for cell in read_cells(manager) if cell.is_up}
    found = read_holders(scope, cells)
    return [
        Inhibited(name, cells[name].uuid, cells[name].unit, holders)
        for name, holders in found.items()
    ]
