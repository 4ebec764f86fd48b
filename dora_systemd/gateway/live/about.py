"""What the page shows of one dataflow besides its numbers: its settings, and why it ended."""

from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.decisions.gateway.page_messages import (
    MAX_ITEMS,
    PROPERTIES,
    fact_values,
    shown_values,
)
from dora_systemd.decisions.views.dataflows import is_up_word
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.report import Report, report_object
from dora_systemd.decisions.why.waits import wait_remedies
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cell, read_cells
from dora_systemd.verbs.facts.ended import ended_rows
from dora_systemd.verbs.facts.reading import read_dataflow
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.facts.waits import read_cpu_waits
from dora_systemd.verbs.list import find_row
from dora_systemd.verbs.why import explain


def read_about(scope: Scope, uuid: str) -> dict[str, Any]:
    """Row, verdict and settings of a dataflow, which may have ended. Raises DoraSystemdError.

    problem: why there is no verdict, or "".
    """
    bus = Bus(scope, for_reading=True)
    row = find_row(bus, scope, uuid)
    found: dict[str, Any] = {"row": dataflow_object(row), "why": None, "facts": _facts(bus, row)}
    try:
        check_readable(scope)
        report = explain(bus, scope, row.uuid, JournalReader())
    except DoraSystemdError as error:
        found["problem"] = error.message
    else:
        row = _with_end(row, report)
        found |= {"row": dataflow_object(row), "why": report_object(report, row)}
    values: dict[str, Any] = shown_values(found)
    return values


def read_ended(scope: Scope, _uuid: str = "") -> dict[str, Any]:
    """The newest dataflow of each name that systemd no longer knows, newest first."""
    loaded = {cell.name for cell in read_cells(Bus(scope, for_reading=True))}
    newest: dict[str, DataflowRow] = {}
    for row in ended_rows(scope):
        newest.setdefault(row.name, row)
    rows = [dataflow_object(row) for name, row in newest.items() if name not in loaded]
    return {"dataflows": shown_values(rows)}


def read_own_releases(scope: Scope, uuid: str) -> dict[str, Any]:
    """The releases of a dataflow, newest first. Raises DoraSystemdError."""
    # Imported late: only deployed dataflows need it.
    from dora_systemd.decisions.views.releases import release_object
    from dora_systemd.verbs.releases.listing import read_releases

    bus = Bus(scope, for_reading=True)
    rows = read_releases(bus, scope, [find_row(bus, scope, uuid).name])
    return {"releases": shown_values(list(map(release_object, rows[:MAX_ITEMS])))}


def read_own_bundles(scope: Scope, uuid: str) -> dict[str, Any]:
    """The bundles of a dataflow, newest first. Raises DoraSystemdError."""
    # Imported late: only a dataflow on a page needs it.
    from dora_systemd.decisions.bundles.table import bundle_object
    from dora_systemd.verbs.bundles.listing import read_bundles

    bus = Bus(scope, for_reading=True)
    rows = read_bundles(scope, [find_row(bus, scope, uuid).name])
    return {"bundles": shown_values(list(map(bundle_object, rows[:MAX_ITEMS])))}


def read_waits(scope: Scope, uuid: str) -> dict[str, Any]:
    """The nodes of a dataflow that wait for a CPU, and the processes that use that CPU.

    Raises DoraSystemdError.
    """
    bus = Bus(scope, for_reading=True)
    cell = Selector(uuid).find(bus)
    waits = read_cpu_waits(read_dataflow(bus, scope, cell)) if cell.is_up else ()
    found = {"waits": list(map(str, waits)), "remedies": wait_remedies(waits, cell.name)}
    values: dict[str, Any] = shown_values(found)
    return values


def _with_end(row: DataflowRow, report: Report) -> DataflowRow:
    """The row of a dataflow that has ended, with what only the journal has of it."""
    if is_up_word(row):
        return row
    verdict = report.verdict
    return row._replace(
        nodes=verdict.nodes,
        nodes_total=len(verdict.nodes),
        restarts=len(verdict.restarts),
        started=verdict.began_us,
        ready=verdict.ready_us,
        ended=row.ended or verdict.at_us,
    )


def _facts(manager: Manager, row: DataflowRow) -> dict[str, Any]:
    cell = read_cell(manager, row.unit)
    if cell is None or cell.uuid != row.uuid:
        return {}
    return fact_values(cell.options, manager.read(cell.unit, PROPERTIES))
