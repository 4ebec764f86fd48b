"""The object of `doractl why -o json`: that of the dataflow, and the verdict."""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.views.objects import dataflow_object, moment, switch_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.lives import parse_number
from dora_systemd.decisions.why.report import Report, remedies

_TOLD = ("event", "node", "nodes", "dataflow", "dataflow_name", "downstream", "cause", "reason")
"""Details of an event that have their own keys."""

_NUMBERS = {
    "peak": "memory_peak_bytes",
    "limit": "memory_limit_bytes",
    "held": "memory_bytes",
    "node_pid": "pid",
    "exit_status": "exit_status",
    "n_restarts": "n_restarts",
}
"""Details that are numbers, by the names that the journal has for them."""


def report_object(report: Report, row: DataflowRow) -> dict[str, Any]:
    """The report for JSON. row: the dataflow as `list` knows it.

    The status is that of the verdict: the journal has more to say about an end than systemd.
    """
    verdict, file = report.verdict, row.dataflow or report.subject.file
    return {
        **dataflow_object(row._replace(status=verdict.status, dataflow=file)),
        "is_failure": verdict.is_failure,
        "cause": str(verdict.cause) or None,
        "summary": verdict.summary or None,
        "now": verdict.now or None,
        "node": verdict.node or None,
        **moment("at", verdict.at_us),
        # systemd's own times, as long as it has them.
        **moment("started", row.started or verdict.began_us),
        **moment("ready", row.ready or verdict.ready_us),
        "stopped_by": verdict.stopped_by or None,
        "given_up": verdict.is_given_up,
        "details": _details(verdict.details),
        "starved": list(verdict.starved),
        "undone": switch_object(report.subject.name, report.undone) if report.undone else None,
        **_history(report),
        "remedies": remedies(report),
    }


def _details(details: Mapping[str, str]) -> dict[str, str | int | None]:
    texts = {key: text for key, text in details.items() if key not in (*_TOLD, *_NUMBERS)}
    numbers = {key: parse_number(details[own]) for own, key in _NUMBERS.items() if own in details}
    return {**texts, **numbers}


def _history(report: Report) -> dict[str, Any]:
    verdict = report.verdict
    return {
        "before": _at(verdict.before_us, summary=verdict.before) if verdict.before else None,
        "restart_history": [
            _at(one.at_us, owner=one.owner, node=one.node, reason=one.reason)
            for one in verdict.restarts
        ],
        "timeline": [
            _at(one.at_us, event=one.name, node=one.node, text=one.text) for one in verdict.timeline
        ],
        "last_lines": [
            _at(one.at_us, node=one.node, text=one.text, times=one.times) for one in report.words
        ],
    }


def _at(at_us: int, **more: str | int) -> dict[str, Any]:
    return {**moment("at", at_us), **{key: one or None for key, one in more.items()}}
