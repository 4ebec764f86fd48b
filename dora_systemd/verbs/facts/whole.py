"""Adds to rows what the table of `list` does without: the restarts left, locks, and the boot."""

from collections.abc import Iterable, Sequence

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.budget import restart_budget
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.list import mark_enabled, row_of
from dora_systemd.verbs.facts.locks import mark_inhibited
from dora_systemd.verbs.facts.reading import Reading, read_dataflow


def read_whole_rows(manager: Manager, scope: Scope, cells: Iterable[Cell]) -> list[DataflowRow]:
    """All that is known of these dataflows."""
    readings = [read_dataflow(manager, scope, cell) for cell in cells]
    return whole_rows(manager, scope, readings, [row_of(one) for one in readings])


def whole_rows(
    manager: Manager, scope: Scope, readings: Sequence[Reading], rows: Sequence[DataflowRow]
) -> list[DataflowRow]:
    """The rows that row_of() has made of `readings`, with all that is known."""
    found = [
        row._replace(restart_budget=restart_budget(manager, scope, one.cell, one.status))
        for one, row in zip(readings, rows, strict=True)
    ]
    return mark_inhibited(scope, mark_enabled(manager, scope, found)) if found else []
