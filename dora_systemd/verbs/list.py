"""`doractl list NAME` and JSON: all that is known of dataflows. The table does not load this."""

from collections.abc import Iterable

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.dataflows import is_up_word
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells
from dora_systemd.verbs.facts.list import mark_enabled
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.facts.whole import read_whole_rows


def all_rows(manager: Manager, scope: Scope, cells: Iterable[Cell]) -> list[DataflowRow]:
    """All that is known of those `cells` that are ours."""
    return read_whole_rows(manager, scope, proven(cells))


def find_row(manager: Manager, scope: Scope, selector: str) -> DataflowRow:
    """The dataflow that `selector` means, which may have ended. Raises DoraSystemdError."""
    wanted, cells = Selector(selector), read_cells(manager)
    # Imported late: the journal is slow, and what runs does not need it.
    if not wanted.meant(cells) and (row := wanted.ended(scope)):
        from dora_systemd.verbs.facts.ended import with_cause

        return mark_enabled(manager, scope, [with_cause(scope, row)])[0]
    row = read_whole_rows(manager, scope, [wanted.loaded(cells)])[0]
    if is_up_word(row):
        return row
    from dora_systemd.verbs.facts.ended import read_end

    return read_end(manager, scope, row)
