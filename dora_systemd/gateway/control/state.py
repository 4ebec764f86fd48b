"""Answers dora's requests about dataflows from systemd, the journal and the node tables."""

import time
from contextlib import suppress
from functools import lru_cache
from typing import Any

from dora_systemd.adapters.bus.manager import ON_THE_WAY, SETTLED, queued_job
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.gateway.answers import (
    bare_descriptor,
    daemon_list,
    dataflow_list,
    node_list,
    stopped,
)
from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.report import Report
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.session import find_by_uuid, find_if_loaded
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.ended import ended_rows
from dora_systemd.verbs.facts.list import read_rows
from dora_systemd.verbs.facts.reason import failure_reason, logs_hint
from dora_systemd.verbs.follow import is_unit_up
from dora_systemd.verbs.start.read import written_dataflow
from dora_systemd.verbs.why import explain, words_of_start

_MOST_ENDED = 20
"""Maximum number of dataflows that ended earlier in `dora list`."""
_FRESH_SECONDS = 5.0
"""Maximum age of the journal's answer about ended dataflows."""


def list_dataflows(scope: Scope) -> dict[str, Any]:
    """List running, failed and last ended dataflows."""
    rows = tuple(map(_row, read_cells(Bus(scope, for_reading=True))))
    return dataflow_list([*rows, *_ended(scope, rows, int(time.monotonic() / _FRESH_SECONDS))])


@lru_cache(maxsize=1)
def _ended(scope: Scope, rows: tuple[DataflowRow, ...], _period: int) -> tuple[DataflowRow, ...]:
    """The dataflows that ended last; reads the journal again only if systemd reports changes."""
    return tuple(ended_rows(scope, rows)[:_MOST_ENDED])


def _row(cell: Cell) -> DataflowRow:
    return DataflowRow(cell.uuid, cell.name, cell.unit, cell.word())


def list_nodes(scope: Scope) -> dict[str, Any]:
    """List all nodes of all running dataflows, with their resource usage."""
    return node_list(read_rows(Bus(scope, for_reading=True), scope))


def list_daemons(scope: Scope) -> dict[str, Any]:
    """The daemons of all running dataflows."""
    return daemon_list(cell.uuid for cell in read_cells(Bus(scope, for_reading=True)) if cell.is_up)


def ended_descriptor(scope: Scope, uuid: str) -> tuple[str, dict[str, Any]]:
    """Name and descriptor of a dataflow without a coordinator.

    If systemd has forgotten the dataflow, the nodes are those in the journal. Raises
    DoraSystemdError.
    """
    cell = find_if_loaded(scope, uuid)
    if cell is not None:
        with suppress(DoraSystemdError):
            return cell.name, dict(written_dataflow(cell.options.dataflow).raw)
    name = find_name(scope, uuid)
    return name, bare_descriptor(JournalReader().known_nodes(scope, name))


def find_name(scope: Scope, uuid: str) -> str:
    """The name of a dataflow that is running or ever ran. Raises DoraSystemdError (NOT_FOUND)."""
    cell = find_if_loaded(scope, uuid)
    name = cell.name if cell else JournalReader().name_of(scope, uuid)
    return name or find_by_uuid(scope, uuid).name


def check(scope: Scope, uuid: str) -> dict[str, Any]:
    """Whether a dataflow runs, or how it has ended. Raises DoraSystemdError (NOT_FOUND)."""
    cell = find_if_loaded(scope, uuid)
    if cell is not None and is_unit_up(Bus(scope, for_reading=True), cell.name):
        return {"DataflowSpawned": {"uuid": uuid}}
    return ended_result(scope, uuid)


def ended_result(scope: Scope, uuid: str) -> dict[str, Any]:
    """Return the reply for an ended dataflow, with the node's last lines, or raise its error."""
    report = explain(Bus(scope, for_reading=True), scope, uuid, JournalReader())
    # As with dora, a stop whose grace duration was over is a failure of the node.
    is_killed = report.verdict.details.get("reason") == BY_SIGKILL
    failed = report.verdict.status == FAILED or is_killed
    failures = {report.verdict.node or report.subject.name: _account(report)} if failed else {}
    return stopped(uuid, time.time_ns() // 1000, failures)


def _account(report: Report) -> str:
    lines = [report.verdict.summary, *(word.text for word in report.words)]
    return "\n".join(
        [*lines, f"doractl {report.subject.flag} why {report.subject.name} shows more"]
    )


def spawned(scope: Scope, uuid: str) -> dict[str, Any] | None:
    """The reply to WaitForSpawn, None while nodes are not ready.

    Raises DoraSystemdError for a start that failed.
    """
    cell = find_if_loaded(scope, uuid)
    if cell is None:
        return _over(scope, uuid)
    bus = Bus(scope, for_reading=True)
    state = bus.read(cell.unit, ["ActiveState", "Job"])
    if state["ActiveState"] in SETTLED:
        return {"DataflowSpawned": {"uuid": uuid}}
    if state["ActiveState"] in ON_THE_WAY or queued_job(state):
        return None
    if state["ActiveState"] != "failed":
        return _over(scope, uuid)
    lines = "".join(f"\n  {line}" for line in words_of_start(bus, scope, uuid))
    reason = failure_reason(bus, cell.unit)
    hint = logs_hint(scope.flag, cell.name, reason)
    error = f"cannot start {cell.name}: {reason}\n\n  hint: {hint}"
    return {"Error": error + (f"\n{lines}" if lines else "")}


def _over(scope: Scope, uuid: str) -> dict[str, Any]:
    """Return the reply for the dora command if the dataflow ended right after its start."""
    word = explain(Bus(scope, for_reading=True), scope, uuid, JournalReader()).verdict.status
    if word == FINISHED:
        return {"Error": f"unknown dataflow {uuid}: it has finished already"}
    raise DoraSystemdError(
        f"cannot wait for the dataflow {uuid}: it is {word.lower()}",
        "dora list shows what runs",
        ExitCode.NOT_RUNNING,
    )
