"""The messages between the status page and the gateway on /api/live: JSON objects. Pure.

The page sends, each with its `type`:
  follow    {dataflow, node, number}          stream the lines of a node, "" for all nodes; ends
                                              the stream or the search before it
  find      {dataflow, node, number, search, since, until, run}
                                              the newest lines that match, in place of a stream
  save      as find                           many more of them, as the text of a file
  unfollow  {}
  graph     {dataflow}
  about     {dataflow}
  ended     {}
  releases  {dataflow}
  timeline  {dataflow}
  bundles   {dataflow}
  waits     {dataflow}
  act       {action, dataflow, node, number, values, release}
                                              action: one of ACTIONS; node "": the dataflow;
                                              values: texts by the settings of "set"; release: of
                                              "rollback", "" for the one before the present one

It receives:
  hello     {version, host, scope}            first
  snapshot  {dataflows, host}                 repeatedly; each as in snapshot.observed_values;
                                              host: as in HostUse.values()
  graph     {dataflow, nodes, edges, problem}
  about     {dataflow, row, why, facts, problem}
                                              row: as `list` has it, with the nodes of an ended one;
                                              why: as in report_object; facts: see fact_values()
  ended     {dataflows, problem}              those that systemd has unloaded, newest first
  releases  {dataflow, releases, problem}     as `doractl releases -o json` has them, newest first
  timeline  {dataflow, lives, marks, is_cut, now_us, since_us, problem}
                                              lives, marks: see timeline.py, oldest first; is_cut:
                                              whether there is more between since_us and these
  bundles   {dataflow, bundles, problem}      as `doractl bundles -o json` has them, newest first
  waits     {dataflow, waits, remedies, problem}
                                              nodes that waited for a CPU and who had it, as `why`
  lines     {number, lines, skipped}          lines: {at_us, node, text, priority, event};
                                              skipped: number of lines left out before these
  file      {number, text}                    a part of the file, in order
  found     {number, count, is_whole, problem, hint}
                                              after the last line or part; is_whole: all that match;
                                              problem: why there is no stream, or ""
  acted     {number, text, problem, hint}     the result of an action
  problem   {text, hint}                      why nothing works at the moment

`dataflow` is a UUID. The page chooses `number`, and answers to its message repeat it. `since` and
`until` are as in systemd.time(7) or a duration, `run` is CURRENT, PREVIOUS or "".
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.cell.environment import with_changes
from dora_systemd.decisions.cell.limits import BY_KEY, LIMITS, Limit, NodeLimits, limits_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.logs.records import Record, record_text
from dora_systemd.decisions.settings.limits import LIVE_SETTINGS
from dora_systemd.decisions.settings.nodes import NODES
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.terminal_text import escaped, one_line, without_sequences
from dora_systemd.values import INFINITY, format_moment

QUESTIONS = ("graph", "about", "ended", "releases", "timeline", "waits", "bundles")
TYPES = ("follow", "find", "save", "unfollow", "act", *QUESTIONS)
ACTIONS = ("stop", "start", "restart", "enable", "disable", "reload", "set", "rollback", "bundle")
RUNS = ("", "CURRENT", "PREVIOUS")
HOT_RELOAD = "hot_reload"
LOG_FIELDS = "MESSAGE,PRIORITY,DORA_NODE,DORA_EVENT,SYSLOG_IDENTIFIER"
MAX_TEXT = 4000
"""Maximum characters of one line for a page."""
MAX_ITEMS = 100
"""Maximum entries of a list in the answer to `about`; the newest ones are kept."""

_MAX_ASKED = 1000
"""Maximum characters of a text in a request."""
_TEXTS = ("type", "dataflow", "node", "action", "search", "since", "until", "run", "release")
_SETTINGS = frozenset({*(one.name for one in LIVE_SETTINGS), NODES, HOT_RELOAD})
_DEFAULT_PRIORITY = 6
_PRIORITIES = frozenset(b"%d" % number for number in range(8))


@dataclass(frozen=True)
class PageMessage:
    """A request of a page."""

    type: str
    dataflow: str = ""
    node: str = ""
    action: str = ""
    number: int = 0
    search: str = ""
    since: str = ""
    until: str = ""
    run: str = ""
    release: str = ""
    values: Mapping[str, str] = field(default_factory=dict)


def parse_message(text: str | bytes) -> PageMessage:
    """Parse a request of a page. Raises DoraSystemdError (USAGE) if it is not valid."""
    try:
        raw = json.loads(text)
        texts = {key: raw.get(key, "") for key in _TEXTS}
        values = dict(raw.get("values", {}))
        message = PageMessage(**texts, number=int(raw.get("number", 0)), values=values)
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise _refusal() from error
    is_known = message.type != "act" or message.action in ACTIONS
    is_known = is_known and message.run in RUNS and values.keys() <= _SETTINGS
    is_known = is_known and values.get(HOT_RELOAD, "on") in ("on", "off")
    if not all(map(_is_text, (*texts.values(), *values.values()))):
        raise _refusal()
    if message.type not in TYPES or not is_known:
        raise _refusal()
    return message


def _is_text(value: object) -> bool:
    """Whether it can be an argument of journalctl: no program takes a NUL in one."""
    return isinstance(value, str) and len(value) <= _MAX_ASKED and value.isprintable()


def _refusal() -> DoraSystemdError:
    hint = "the page may be of another version: reload it"
    return usage_error("cannot read what the page sent", hint)


def line_values(record: Record) -> dict[str, Any]:
    """A record of the journal as a line for the page."""
    identifier = record_text(record, "SYSLOG_IDENTIFIER")
    priority = record.get("PRIORITY", b"")
    return {
        "at_us": int(record.get("__REALTIME_TIMESTAMP", b"0")),
        "node": record_text(record, "DORA_NODE") or identifier.partition("/")[2],
        "text": _printable(record_text(record, "MESSAGE")),
        "priority": int(priority) if priority in _PRIORITIES else _DEFAULT_PRIORITY,
        "event": record_text(record, "DORA_EVENT"),
    }


def _printable(text: str) -> str:
    """Remove colours and other terminal sequences; show remaining control characters escaped."""
    text = without_sequences(text)
    return escaped(text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}…")


def saved_line(line: Mapping[str, Any]) -> str:
    """A line of line_values() in a file, with the time in UTC."""
    origin = one_line(line["node"]) or "dataflow"
    return f"{format_moment(line['at_us'])} {origin}: {one_line(line['text'])}\n"


def shown_values(value: Any, most: int = MAX_ITEMS) -> Any:
    """A JSON value with printable texts of MAX_TEXT and lists of `most`: nodes write them."""
    if isinstance(value, Mapping):
        return {key: shown_values(one, most) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [shown_values(one, most) for one in value[-most:]]
    return _printable(value) if isinstance(value, str) else value


def graph_values(dataflow: Dataflow) -> dict[str, Any]:
    """Nodes and edges of a descriptor; dora's own sources, such as timers, count as nodes."""
    nodes = [{"id": node.id, "kind": str(node.kind)} for node in dataflow.nodes]
    edges = [
        _edge(node.id, given.name, given.source) for node in dataflow.nodes for given in node.inputs
    ]
    sources = dict.fromkeys(edge["from"] for edge in edges if edge["from"].startswith("dora/"))
    return {"nodes": [*({"id": one, "kind": "dora"} for one in sources), *nodes], "edges": edges}


def _edge(node: str, name: str, source: str) -> dict[str, str]:
    origin, _, output = (source, "", "") if source.startswith("dora/") else source.partition("/")
    return {"from": origin, "output": output, "to": node, "input": name}


_LEVEL = ("NoNewPrivileges", "MemoryDenyWriteExecute")
_NETWORK = ("PrivateNetwork", "IPAddressDeny")


def _read_as(limit: Limit) -> str:
    """The property of the limit on D-Bus, see org.freedesktop.systemd1(5)."""
    return "CPUQuotaPerSecUSec" if limit.property == "CPUQuota" else limit.property


PROPERTIES = (*map(_read_as, LIMITS), *_LEVEL, *_NETWORK, "Environment")
"""What fact_values() needs of the unit."""


def fact_values(options: RunnerOptions, unit: Mapping[str, Any]) -> dict[str, Any]:
    """Limits and switches, with the keys of the settings; texts as `doractl set` takes them.

    unit: its PROPERTIES. Raises DoraSystemdError for an Environment= that is not ours.
    """
    environment = dict(one.partition("=")[::2] for one in unit["Environment"] or ())
    now = with_changes(options, environment)
    limits = {one: unit[_read_as(one)] for one in LIMITS}
    nodes = map(_finite, limits_of(now))
    return {
        **{one.key: one.format(value) for one, value in limits.items() if _is_set(value)},
        NODES: [_limit_text(one) for one in nodes if one.limits],
        "hot_reload": now.hot_reload,
        "sandbox": _level(unit),
        "network": _network(unit),
    }


def _limit_text(one: NodeLimits) -> str:
    pairs = (f"{key}={BY_KEY[key].format(value)}" for key, value in one.limits)
    return f"{one.node}:{','.join(pairs)}"


def _finite(one: NodeLimits) -> NodeLimits:
    return one._replace(limits=tuple(pair for pair in one.limits if pair[1] != INFINITY))


def _is_set(value: object) -> bool:
    return isinstance(value, int) and value != INFINITY


def _level(unit: Mapping[str, Any]) -> str:
    """The level of the sandbox, by a property that only it and those above it have."""
    is_on, is_strict = (unit[one] for one in _LEVEL)
    return "strict" if is_on and is_strict else "default" if is_on else "none"


def _network(unit: Mapping[str, Any]) -> str:
    is_private, denied = (unit[one] for one in _NETWORK)
    return "private" if is_private else "loopback" if denied else "host"
