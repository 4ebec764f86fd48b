"""The verdict of `doractl why`: as one screen of text, and as the object of -o json. Pure."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.cell.restarts import budget_words
from dora_systemd.decisions.cell.status import format_stopped
from dora_systemd.decisions.logs.journal_events import BUILD_FAILED, ROLLED_BACK
from dora_systemd.decisions.releases.past import Switch
from dora_systemd.decisions.views.dataflows import RESTARTING, colored_state
from dora_systemd.decisions.views.formats import UNKNOWN, local_time, zoned_time
from dora_systemd.decisions.views.inhibitors import format_holders
from dora_systemd.decisions.views.objects import dataflow_object, moment, switch_object
from dora_systemd.decisions.views.rows import Bundles, DataflowRow, Holder, format_bundles
from dora_systemd.decisions.why.last_lines import Word, shown_last
from dora_systemd.decisions.why.lives import parse_number
from dora_systemd.decisions.why.remedies import (
    AND_RESTART,
    about_core_dump,
    known_remedy,
    of_release,
    remedy_of,
)
from dora_systemd.decisions.why.stack import Frame
from dora_systemd.decisions.why.verdict import Restart, Verdict
from dora_systemd.decisions.why.waits import CpuWait, format_cpu_waits, wait_remedies
from dora_systemd.names import release_of
from dora_systemd.terminal_text import cut, one_line, wrapped
from dora_systemd.values import SECOND, format_duration, format_rounded_size, shell_word

LINES = 20
"""Maximum number of last lines to show."""
_TIMELINE = 7
_SIZE = "[1-9][0-9]{0,18}"
_TITLE_WIDTH = 10
_MILLISECOND = 1000
_BOLD, _PLAIN = "\x1b[1m", "\x1b[0m"

_GIVEN_UP = "systemd has stopped restarting it; doractl restart {name} resets the counter"
_WAITING = "systemd restarts it automatically; doractl stop {name} prevents that"
_THERE = "doractl -H {host} why {name} shows what machine {machine} has seen"
_AGAIN = "nothing: dora restarts {node} automatically"
_AGAIN_FIXED = "dora restarts {node} automatically, and so finds it fixed"
_HOPELESS = r"(SyntaxError|IndentationError|TabError|ModuleNotFoundError|ImportError)\b"
"""Begins the last line of a Python program that no restart helps."""
_FIX_RELEASE = "fix {node}, then run: doractl deploy --name {name}"
_OTHERS = "fix {others} as well; doractl logs {name} --node {other} has its last lines"
_AWAY = "{away} down until doractl restart {name}; the other nodes keep running"
_HELD = (
    "{node} stays down until its file is saved, which hot reload sees, or until "
    "doractl reload {name} --node {node}; the other nodes keep running"
)


@dataclass(frozen=True)
class Subject:
    """The dataflow of a verdict."""

    uuid: str
    name: str
    unit: str
    flag: str
    file: str = ""  # its descriptor, "" if that is not known any more
    is_loaded: bool = False


@dataclass(frozen=True)
class Report:
    """The output of `doractl why`."""

    subject: Subject
    verdict: Verdict
    words: tuple[Word, ...] = ()  # the last lines, of verdict.node or of all nodes
    budget: Mapping[str, int | None] | None = None
    inhibitors: tuple[Holder, ...] = ()  # who inhibits a restart now
    is_held: bool = False  # verdict.node waits for a hot reload
    # the other ones by name, each with its host, or "" if that is not known
    machines: Mapping[str, str] = field(default_factory=dict)
    # the last change in the history of releases, if it was no new release
    undone: Switch | None = None
    is_of_trial: bool = False  # words are of the trial that has failed, in which `undone` ended
    stack: tuple[Frame, ...] = ()  # of verdict.node, if a signal ended it
    keeps_core_dumps: bool = True  # whether this machine does
    waits: tuple[CpuWait, ...] = ()  # of nodes that run, for a CPU
    outside: str = ""  # the containers outside of the cgroups of the nodes
    bundles: Bundles | None = None  # of failures of the dataflow

    @property
    def node(self) -> str:
        """The node of the last lines, "" for all nodes."""
        return self.undone.node if self.undone and self.is_of_trial else self.verdict.node


def remedies(report: Report) -> list[str]:
    """Return the remedies, one line each."""
    verdict, subject = report.verdict, report.subject
    lines = (one.text for one in report.words)
    hint = known_remedy(lines, report.node) if report.node else ""
    texts = _of_passing(report) if verdict.is_passing else [remedy_of(verdict)]
    if report.is_of_trial and report.undone:
        texts = [_FIX_RELEASE] if report.node else []
    if verdict.others and not report.is_of_trial:
        texts.append(_OTHERS)
    machine = verdict.details.get("machine", "")
    if host := report.machines.get(machine):
        texts.append(_THERE)
    if verdict.is_away:
        texts.append(_HELD if report.is_held else _AWAY)
    if verdict.is_given_up:
        texts.append(_GIVEN_UP)
    elif verdict.status == RESTARTING:
        texts.append(_WAITING)
    has_dump, has_stack = report.keeps_core_dumps, bool(report.stack)
    texts = [about_core_dump(text, has_dump, has_stack) for text in texts]
    values = {
        "name": subject.name,
        "node": report.node or "the node",
        "others": ", ".join(verdict.others),
        "other": (*verdict.others, "")[0],
        "away": _away(verdict),
        "file": shell_word(subject.file or "FILE"),
        "unit": subject.unit,
        "flag": subject.flag,
        "pid": parse_number(verdict.details.get("node_pid", "")) or "PID",
        "machine": machine,
        "host": host,
    }
    filled = [*filter(None, [hint]), *(text.format(**values) for text in texts if text)]
    filled += wait_remedies(report.waits, subject.name)
    if report.is_held and verdict.is_away:
        again = f", then run: doractl restart {subject.name}"
        return [text.replace(again, ", and save it") for text in filled]
    if release_of(subject.file) or any(one.name == ROLLED_BACK for one in verdict.timeline):
        return [of_release(text, subject.name, subject.file) for text in filled]
    if subject.is_loaded:
        return filled
    again = f"doractl start {values['file']} --name {subject.name}"
    return [text.replace(f"doractl restart {subject.name}", again) for text in filled]


def _of_passing(report: Report) -> list[str]:
    """Return the remedy for a node that dora is about to restart and that ends again and again."""
    verdict = report.verdict
    has_helped = not any(one.node == verdict.node for one in verdict.restarts)
    if has_helped and not any(re.match(_HOPELESS, one.text) for one in report.words[-1:]):
        return [_AGAIN]
    return [remedy_of(verdict).replace(AND_RESTART, ""), _AGAIN_FIXED]


def _away(verdict: Verdict) -> str:
    """Format "camera stays", "camera, plot stay"."""
    verb = "stay" if verdict.others else "stays"
    return f"{', '.join((verdict.node, *verdict.others))} {verb}"


def format_report(report: Report, width: int | None = None, want_colors: bool = False) -> str:
    """The report as at most 45 lines, if it need not be wrapped.

    width: of the terminal. What happened and the last lines are cut there, all else is wrapped.
    """
    blocks = [
        [_title(report, width, want_colors), *_wrapped(_facts(report), width, 2 + _TITLE_WIDTH)],
        _section("Where it crashed:", _cut(map(str, report.stack), width), want_colors),
        _section("What happened:", _cut(_timeline(report), width), want_colors),
        _section(_words_title(report), _cut(_words(report), width), want_colors, width),
        _section("What to do:", _wrapped(remedies(report), width, 2), want_colors),
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def _title(report: Report, width: int | None, want_colors: bool) -> str:
    status = report.verdict.status
    name = cut(report.subject.name, None if width is None else width - len(status) - 2)
    if want_colors:
        name, status = f"{_BOLD}{name}{_PLAIN}", colored_state(status, status)
    return f"{name}: {status}"


def _section(
    title: str, lines: list[str], want_colors: bool, width: int | None = None
) -> list[str]:
    """The lines below their title, which is wrapped: a command in it can be copied."""
    if not lines:
        return []
    titles = [title] if width is None else wrapped(title, width, 2)
    return [*(f"{_BOLD}{one}{_PLAIN}" if want_colors else one for one in titles), *lines]


def _cut(lines: Iterable[str], width: int | None) -> list[str]:
    # Texts of nodes must not control the terminal, or add lines to the report.
    return [cut(f"  {one_line(line)}", width) for line in lines]


def _wrapped(lines: Iterable[str], width: int | None, indent: int) -> list[str]:
    """Lines of at most `width` characters, as wrapped()."""
    shown = _cut(lines, None)
    if width is None:
        return shown
    return [piece for line in shown for piece in wrapped(line, width, indent)]


def _facts(report: Report) -> list[str]:
    verdict, subject = report.verdict, report.subject
    facts = {
        "Why": verdict.summary,
        "Now": verdict.now,
        "When": _when(verdict),
        "Machines": _machine_words(report.machines),
        "Memory": _memory_words(verdict.details),
        "CPU": format_cpu_waits(report.waits),
        "Outside": report.outside,
        "Starved": ", ".join(verdict.starved),
        "Stopped": format_stopped(verdict.stopped),
        "Restarts": _restart_words(verdict.restarts),
        "Budget": _budget_words(report),
        "Inhibit": format_holders(report.inhibitors) if report.inhibitors else "",
        "Before": f"{verdict.before} ({zoned_time(verdict.before_us)})" if verdict.before else "",
        "Bundle": format_bundles(report.bundles, verdict.before_us or verdict.began_us),
        "Unit": f"{subject.unit} ({subject.uuid})",
        "File": subject.file,
        "Release": release_of(subject.file),
        "Undone": _undone(report),
    }
    return [f"{key + ':':<{_TITLE_WIDTH}}{text}" for key, text in facts.items() if text]


def _machine_words(machines: Mapping[str, str]) -> str:
    """Format "head, gpu (alice@gpu-box)"; "" for one machine."""
    others = (f"{name} ({host})" if host else name for name, host in machines.items())
    return ", ".join((HEAD, *others)) if machines else ""


def _undone(report: Report) -> str:
    """The last release that failed its build or trial or was rolled back from, if it is known."""
    names = (BUILD_FAILED,) if report.undone else (BUILD_FAILED, ROLLED_BACK)
    found = [
        (one.at_us, one.detail("release"), one.detail("reason"))
        for one in report.verdict.timeline
        if one.name in names
    ]
    if end := report.undone:
        found.append((end.at_us, end.former, end.reason or f"rolled back by {end.by or UNKNOWN}"))
    if not found:
        return ""
    at_us, release, reason = max(found)
    return f"{release} at {zoned_time(at_us)}: {reason}"


def _budget_words(report: Report) -> str:
    """The remaining restarts by systemd, while there may be one."""
    budget = report.budget
    is_due = budget and (budget["used"] or report.verdict.status == RESTARTING)
    return budget_words(budget) if budget and is_due else ""


def _when(verdict: Verdict) -> str:
    if not verdict.at_us:
        times = {"started": verdict.began_us, "ready": verdict.ready_us}
        return ", ".join(f"{name} {zoned_time(at)}" for name, at in times.items() if at)
    lasted = verdict.at_us - verdict.began_us
    is_told = verdict.began_us and lasted >= _MILLISECOND
    words = f", {_span(lasted)} after its start" if is_told else ""
    return f"{zoned_time(verdict.at_us)}{words}"


def _span(duration: int) -> str:
    """A duration in µs as text, in whole seconds from one second on."""
    unit = SECOND if duration >= SECOND else _MILLISECOND
    return format_duration(duration // unit * unit)


def _memory_words(details: Mapping[str, str]) -> str:
    sizes = [
        f"{key} {format_rounded_size(int(details[key]))}"
        for key in ("peak", "limit", "held")
        if re.fullmatch(_SIZE, details.get(key, ""))
    ]
    owner = {"dataflow": " of the dataflow", "machine": "; the machine had no memory left"}
    return ", ".join(sizes) + owner.get(details.get("owner", ""), "") if sizes else ""


def _restart_words(restarts: Sequence[Restart]) -> str:
    """Format "detector 3 (exit code 1), all of it 1 (the dora daemon is gone)"."""
    groups: dict[tuple[str, str], int] = {}
    for one in restarts:
        key = (one.node or "dataflow", one.reason)
        groups[key] = groups.get(key, 0) + 1
    return ", ".join(f"{who} {count} ({why})" for (who, why), count in groups.items())


def _timeline(report: Report) -> list[str]:
    news = report.verdict.timeline
    lines = [f"{_clock(one.at_us)}  {one.text or one.name}" for one in news]
    left = len(lines) - _TIMELINE
    if left > 0:
        lines[2 : 2 - _TIMELINE] = [f"... {left} more ..."]
    return lines


def _clock(moment: int) -> str:
    return local_time(moment)[5:] if moment else UNKNOWN


def _words_title(report: Report) -> str:
    node = report.node
    count = "line" if len(report.words) == 1 else f"{len(report.words)} lines"
    every = f"doractl logs {report.subject.name}" + (f" --node {node}" if node else "")
    release = f" in {report.undone.former}" if report.undone and report.is_of_trial else ""
    return f"The last {count} of {node or 'its nodes'}{release} (all: {every}):"


def _words(report: Report) -> list[str]:
    node, shown = report.node, shown_last(report.words, LINES)
    return [f"{_clock(one.at_us)[6:]}  {_line(one, node)}" for one in shown]


def _line(word: Word, node: str) -> str:
    return word.text if node else f"{word.node}: {word.text}"


_TOLD = ("event", "node", "nodes", "dataflow", "dataflow_name", "downstream", "cause", "reason")
"""Details of an event that have their own keys."""

_NUMBERS = {
    "peak": "memory_peak_bytes",
    "limit": "memory_limit_bytes",
    "held": "memory_bytes",
    "held_peak": "memory_held_peak_bytes",
    "mapped_peak": "memory_mapped_peak_bytes",
    "cpu_peak": "cpu_peak_percent",
    "node_pid": "pid",
    "exit_status": "exit_status",
    "n_restarts": "n_restarts",
}
"""Details that are numbers, by the names that the journal has for them."""


def report_object(report: Report, row: DataflowRow) -> dict[str, Any]:
    """The report for JSON. row: the dataflow as `list` knows it.

    The status is that of the verdict: the journal has more records of an end than systemd.
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
        "stack": [one._asdict() for one in report.stack],
        "cpu_waits": [one.values() for one in report.waits],
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
