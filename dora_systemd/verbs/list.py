"""`doractl list NAME`: all that is known of one dataflow. The table of all does not load this."""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.dataflows import DataflowRow, is_up_word
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.budget import restart_budget
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import dataflow_row, mark_enabled
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.facts.selector import Selector


def find_row(manager: Manager, scope: Scope, selector: str) -> DataflowRow:
    """The dataflow that `selector` means, which may have ended. Raises DoraSystemdError."""
    wanted, cells = Selector(selector), read_cells(manager)
    if not wanted.meant(cells) and (row := wanted.ended(scope)):
        return row
    cell = wanted.loaded(cells)
    row = dataflow_row(manager, scope, cell)
    if not is_up_word(row):
        # Imported late: the journal is slow, and what runs does not need it.
        from dora_systemd.verbs.facts.ended import read_end

        row = read_end(manager, scope, row)
    budget = restart_budget(manager, scope, cell, read_status(scope, cell))
    return mark_enabled(manager, scope, [row._replace(restart_budget=budget)])[0]
