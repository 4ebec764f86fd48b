"""Formats advices: human-readable, and as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dora_systemd.decisions.advice.evidence import Recorded, lives_of
from dora_systemd.decisions.advice.rules import Advice, format_span, too_little
from dora_systemd.decisions.views.formats import zoned_time
from dora_systemd.values import SECOND, format_moment


@dataclass(frozen=True)
class AdviceReport:
    """The advices for one dataflow. file: its settings file, "" if none can be written."""

    name: str
    uuid: str
    recorded: Recorded
    advices: Sequence[Advice]
    file: str = ""
    is_applied: bool = False


def format_report(report: AdviceReport) -> str:
    """The report for a person."""
    recorded = report.recorded
    if little := too_little(recorded):
        return f"{report.name}: {little}"
    span = f"{recorded.lives} lives, {format_span(recorded.duration_us)}"
    if not report.advices:
        return f"{report.name}: nothing to change, after {span}"
    lines = [f"{report.name}: {span}"]
    for one in report.advices:
        who = one.node or "all nodes together"
        lines += ["", f"{who}: {_change(one)}", f"  {_evidence(one, recorded.lives)}"]
    return "\n".join([*lines, *_ending(report)])


def _change(advice: Advice) -> str:
    least = ", or more" if advice.is_least else ""
    return f"{advice.setting} {advice.value}{least} (now {advice.now or 'none'})"


def _evidence(advice: Advice, lives: int) -> str:
    last = max(one.at_us for one in advice.seen)
    return f"{advice.why}, in {lives_of(advice.seen)} of {lives} lives, last {zoned_time(last)}"


def _ending(report: AdviceReport) -> list[str]:
    if report.is_applied:
        return ["", f"Settings changed: {report.file}; the next start has them"]
    if report.file:
        return ["", f"Into {report.file}: doractl advise {report.name} --apply"]
    return []


def report_object(report: AdviceReport) -> dict[str, Any]:
    """The report for JSON."""
    recorded = report.recorded
    return {
        "name": report.name,
        "uuid": report.uuid,
        "lives": recorded.lives,
        "duration_us": recorded.duration_us,
        "too_little": too_little(recorded) or None,
        "file": report.file or None,
        "applied": report.is_applied,
        "advice": [_advice_object(one) for one in report.advices],
    }


def _advice_object(advice: Advice) -> dict[str, Any]:
    last = max(advice.seen, key=lambda one: one.at_us)
    top = max(advice.seen, key=lambda one: one.value)
    return {
        "node": advice.node or None,
        "setting": advice.setting,
        "now": advice.now or None,
        "value": advice.value,
        "at_least": advice.is_least,
        "reason": advice.why,
        "seen": top.value,
        "count": len(advice.seen),
        "lives": lives_of(advice.seen),
        "last": format_moment(last.at_us // SECOND * SECOND),
        "last_us": last.at_us,
    }
