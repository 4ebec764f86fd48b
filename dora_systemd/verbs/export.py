"""`doractl export`: the unit of a dataflow as a file that needs nothing of doractl."""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.unit.file import persistent_unit, plain_target
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.show import unit_files
from dora_systemd.verbs.start.enable import no_unit_file, refuse_attached


def export_cell(manager: Manager, scope: Scope, cell: Cell) -> str:
    """The unit as one file, with its drop-ins in it. Raises DoraSystemdError."""
    refuse_attached(cell)
    if cell.options.placed:
        raise no_unit_file(cell.name, "it runs on several machines")
    texts = list(unit_files(manager, cell).values())
    return persistent_unit(texts, cell.options, scope.is_user, plain_target(scope.is_user))
