"""`doractl list NAME` and JSON: all that is known of dataflows. The table does not load this."""

from collections.abc import Iterable, Sequence
from contextlib import suppress

from dora_systemd.adapters.bundles.store import BundleStore
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.views.dataflows import is_up_word
from dora_systemd.decisions.views.rows import Bundles, DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.budget import restart_budget
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells
from dora_systemd.verbs.facts.containers import read_containers
from dora_systemd.verbs.facts.list import mark_enabled, row_of
from dora_systemd.verbs.facts.locks import mark_inhibited
from dora_systemd.verbs.facts.reading import Reading, read_dataflow
from dora_systemd.verbs.facts.selector import Selector


def all_rows(manager: Manager, scope: Scope, cells: Iterable[Cell]) -> list[DataflowRow]:
    """Return the complete rows of those `cells` that are ours."""
    return read_whole_rows(manager, scope, proven(cells))


def find_row(manager: Manager, scope: Scope, selector: str) -> DataflowRow:
    """The dataflow that `selector` means, which may have ended. Raises DoraSystemdError."""
    wanted, cells = Selector(selector), read_cells(manager)
    # Imported late: the journal is slow, and what runs does not need it.
    if not wanted.meant(cells) and (row := wanted.ended(scope)):
        from dora_systemd.verbs.facts.ended import with_cause
        from dora_systemd.verbs.start.restart_ended import recorded_file

        row = row._replace(dataflow=recorded_file(scope, row.name, row.uuid))
        return mark_bundles(scope, mark_enabled(manager, scope, [with_cause(scope, row)]))[0]
    row = read_whole_rows(manager, scope, [wanted.loaded(cells)])[0]
    if is_up_word(row):
        return row
    from dora_systemd.verbs.facts.ended import read_end

    return read_end(manager, scope, row)


def read_whole_rows(manager: Manager, scope: Scope, cells: Iterable[Cell]) -> list[DataflowRow]:
    """Return the complete rows of these dataflows."""
    readings = [read_dataflow(manager, scope, cell) for cell in cells]
    return whole_rows(manager, scope, readings, [row_of(one) for one in readings])


def whole_rows(
    manager: Manager, scope: Scope, readings: Sequence[Reading], rows: Sequence[DataflowRow]
) -> list[DataflowRow]:
    """The rows that row_of() has made of `readings`, with all that is known."""
    found = [
        with_containers(one, row)._replace(
            restart_budget=restart_budget(manager, scope, one.cell, one.status)
        )
        for one, row in zip(readings, rows, strict=True)
    ]
    if not found:
        return []
    return mark_bundles(scope, mark_inhibited(scope, mark_enabled(manager, scope, found)))


def with_containers(reading: Reading, row: DataflowRow) -> DataflowRow:
    """The row with the containers that its nodes have started."""
    if not (found := read_containers(reading.groups)):
        return row
    nodes = (one._replace(containers=found.get(one.node, ())) for one in row.nodes)
    return row._replace(nodes=tuple(nodes))


def read_of_failures(scope: Scope, name: str) -> Bundles | None:
    """What failures of a dataflow have left; None if that is nothing, or may not be read."""
    with suppress(DoraSystemdError):
        found = BundleStore(scope.state_root, name).of_failures()
        return found if found != Bundles() else None
    return None


def mark_bundles(scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The rows with what failures have left."""
    return [row._replace(bundles=read_of_failures(scope, row.name)) for row in rows]
