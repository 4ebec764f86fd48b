"""`doractl advise`: advices from the lives in the journal, and their way into the settings file."""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.adapters.host.yaml_edit import with_value
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.advice.evidence import EVENTS, Recorded, collect
from dora_systemd.decisions.advice.report import AdviceReport
from dora_systemd.decisions.advice.rules import Advice, Current, advise
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import owes_of, policies_of
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.cell.stops import named_stops
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.descriptor.nodes import NodeKind
from dora_systemd.decisions.logs.journal_events import END_EVENTS
from dora_systemd.decisions.logs.query import scope_matches
from dora_systemd.decisions.settings.resolve import with_settings
from dora_systemd.decisions.why.lives import Life, find_lives, parse_happening
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import release_of, settings_path
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.owned import replace_file, writer_of
from dora_systemd.values import INFINITY, as_list, as_mapping, shown
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.start.read import Files, SettingsFile, read_files
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.restart_ended import Asked, find_asked, find_start
from dora_systemd.verbs.start.settings import settings_of

_MOST_RECORDS = 20_000
_NUMBERS = ("HELD_PEAK", "CPU_PEAK", "HELD", "LIMIT", "STALLED", "CPU_LIMIT")
_WORDS = ("EVENT", "NODE", "EXIT", "OWNER", "OUTPUT", "REASON", "DATAFLOW")
_FIELDS = ("_SYSTEMD_INVOCATION_ID", *(f"DORA_{one}" for one in (*_NUMBERS, *_WORDS)))
_LIMITS = {"memory_limit": "MemoryMax", "cpu_limit": "CPUQuotaPerSecUSec"}


@dataclass(frozen=True)
class Project:
    """The files of a dataflow, and how the next start reads them."""

    scope: Scope
    request: StartRequest
    files: Files

    @property
    def path(self) -> Path:
        """The settings file of the dataflow, which need not exist."""
        return Path(settings_path(str(self.files.path)))

    def current(self, own: SettingsFile | None) -> Current:
        """The present settings with this settings file. Raises DoraSystemdError."""
        files = self.files._replace(beside=own)
        settings = settings_of(self.scope, files, self.request)
        path = str(files.path)
        directory = str(files.path.parent)
        options = RunnerOptions(files.name, self.request.uuid, path, directory, "/dora")
        limits = {key: settings.values[key] for key in _LIMITS}
        return current_of(with_settings(options, settings), files.dataflow(), limits)


def read_advice(
    manager: Manager, scope: Scope, selector: str, environment: Mapping[str, str]
) -> tuple[AdviceReport, Project | None]:
    """Read the lives of a dataflow, and what they suggest; None for a release.

    environment: the caller's variables. Raises DoraSystemdError (NOT_FOUND).
    """
    found = find_start(manager, scope, Selector(selector))
    project = _project(scope, found, environment)
    if project:
        current = project.current(project.files.beside)
    else:
        assert isinstance(found, Cell)
        current = _of_release(manager, found)
    lives = read_all_lives(JournalReader(), scope, found.name)
    recorded = _collected(lives, current, isinstance(found, Cell) and found.is_up)
    file = str(project.path) if project else ""
    return AdviceReport(found.name, found.uuid, recorded, advise(recorded, current), file), project


def _collected(lives: Sequence[Life], current: Current, is_up: bool) -> Recorded:
    has_ended = not lives or not is_up or lives[-1].last(*END_EVENTS) is not None
    now_us = 0 if has_ended else time.time_ns() // 1000
    after = {node: stop.after for node, stop in current.stops.items()}
    return collect(lives, after, now_us)


def read_all_lives(journal: JournalReader, scope: Scope, name: str) -> list[Life]:
    """The lives of all dataflows of that name, oldest first."""
    matches = [*scope_matches(scope, name), *(f"DORA_EVENT={one}" for one in EVENTS)]
    records = islice(journal.newest(matches, None, fields=_FIELDS), _MOST_RECORDS)
    found = [one for one in map(parse_happening, records) if one is not None]
    return find_lives(reversed(found))


def _project(scope: Scope, found: Cell | Asked, environment: Mapping[str, str]) -> Project | None:
    """The files of a dataflow; None for a release, whose settings are those of its project."""
    if isinstance(found, Cell):
        path, asked = found.options.dataflow, find_asked(scope, Selector(found.name))
    else:
        path, asked = found.dataflow, found
    if release_of(path):
        return None
    flags = asked.flags if asked and asked.uuid == found.uuid else {}
    places = {key: environment[key] for key in ("HOME", "XDG_CONFIG_HOME") if key in environment}
    request = StartRequest(path, found.name, flags, places, uuid=found.uuid)
    return Project(scope, request, read_files(request))


def _of_release(manager: Manager, cell: Cell) -> Current:
    path = Path(cell.options.dataflow)
    document = parse_yaml(decoded(read_file(path).data, path), path)
    values = manager.read(cell.unit, list(_LIMITS.values()))
    limits = {key: values[name] for key, name in _LIMITS.items()}
    return current_of(cell.options, parse_dataflow(document, str(path)), limits)


def current_of(
    options: RunnerOptions, dataflow: Dataflow, limits: Mapping[str, int | None]
) -> Current:
    """The settings of a dataflow. limits: those of the dataflow as a whole."""
    nodes = {node.id: node for node in dataflow.nodes if node.kind is not NodeKind.DYNAMIC}
    policies = {**dict.fromkeys(nodes, restart_of(options)), **policies_of(options)}
    own = {ident for ident, node in nodes.items() if node.restart_policy or node.backoff}
    return Current(
        frozenset(nodes),
        _limits(options, limits, "memory_limit"),
        _limits(options, limits, "cpu_limit"),
        {node: policy for node, policy in policies.items() if node not in own},
        named_stops(options.by_node("stop")),
        options.grace,
        options.of_dataflow("stop_limit"),
        owes_of(options),
        *_machine(),
    )


def _limits(options: RunnerOptions, limits: Mapping[str, int | None], key: str) -> dict[str, int]:
    of_all = limits[key]
    return {**options.by_node(key), "": INFINITY if of_all is None else of_all}


def _machine() -> tuple[int, int]:
    """The memory of this machine in bytes, and its processors."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return memory, os.cpu_count() or 1


def apply(report: AdviceReport, project: Project | None) -> AdviceReport:
    """Write the advices into the settings file, all or none.

    Raises DoraSystemdError; then nothing is changed.
    """
    if project is None:
        hint = "change the settings file of its project, and deploy that"
        raise bad_input(f"cannot change the settings of {report.name}: it runs a release", hint)
    if not report.advices:
        return report
    beside, path = project.files.beside, project.path
    before = decoded(beside.data, path) if beside else ""
    text = before
    for advice in report.advices:
        text = _changed(text, path, advice)
    _check(report, project, text)
    place = beside.place if beside else project.files.place
    data = beside.data if beside else b""
    mark = b"\xef\xbb\xbf" if data.startswith(b"\xef\xbb\xbf") else b""
    replace_file(str(path), data, mark + text.encode(), writer_of(place))
    return replace(report, is_applied=True)


def _changed(text: str, path: Path, advice: Advice) -> str:
    """The text with one advice. Raises DoraSystemdError (BAD_INPUT) if that is not for lines."""
    document = as_mapping(parse_yaml(text, path, allow_empty=True)) if text.strip() else {}
    place = _place(document, advice.place)
    after = with_value(text, place, advice.value)
    if after is None or _put(document, place, advice.value) != _read_back(after, path, place):
        message = f"cannot change {shown(str(path))} by itself"
        raise bad_input(message, f"write {': '.join((*advice.place, advice.value))} there")
    return after


def _place(document: Mapping[str, Any], place: tuple[str, ...]) -> tuple[str, ...]:
    """The keys of a value; `stop: 20s` is the short form of `stop: {within: 20s}`."""
    if place[-2:] != ("stop", "within"):
        return place
    found: Any = document
    for key in place[:-1]:
        found = as_mapping(found).get(key)
    return place if found is None or isinstance(found, dict) else place[:-1]


def _read_back(text: str, path: Path, place: Sequence[str]) -> object:
    """The document that the new text has, with the changed value as a text."""
    try:
        document = parse_yaml(text, path)
    except DoraSystemdError:
        return None
    found: Any = document
    for key in place:
        found = _below(found, key)
    return _put(document, place, str(found))


def _below(value: Any, key: str) -> Any:
    if isinstance(value, list):
        return next((one for one in value if as_mapping(one).get("output") == key), None)
    return as_mapping(value).get(key)


def _put(document: Any, place: Sequence[str], value: str) -> Any:
    """A copy of the document with another value; an anchor that is used twice stays one."""
    key, *rest = place
    if isinstance(document, list):
        items = as_list(document)
        return [_put(one, rest, value) if one is _below(items, key) else one for one in items]
    old = as_mapping(document)
    return {**old, key: _put(old.get(key), rest, value) if rest else value}


def _check(report: AdviceReport, project: Project, text: str) -> None:
    """Refuse a change that has no effect, because another setting takes precedence."""
    path, files = project.path, project.files
    place = files.beside.place if files.beside else files.place
    after = SettingsFile(path, place, text.encode(), parse_yaml(text, path))
    left = advise(report.recorded, project.current(after))
    places = {one.place for one in report.advices}
    for one in left:
        if one.place in places:
            who = f"node {one.node}" if one.node else report.name
            hint = "a flag of its start takes precedence"
            raise bad_input(f"cannot change {one.setting} of {who} in {shown(str(path))}", hint)
