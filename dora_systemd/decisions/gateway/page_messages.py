"""The messages between the status page and the gateway on /api/live: JSON objects. Pure.

The page sends, each with its `type`:
  follow    {dataflow, node, number}          stream the lines of a node, "" for all nodes; ends
                                              the stream before it
  unfollow  {}
  graph     {dataflow}
  act       {action, dataflow, node, number}  action: "stop" or "restart"; node "": the dataflow

It receives:
  hello     {version, host, scope}            first
  snapshot  {dataflows}                       repeatedly; each as in snapshot.observed_values
  graph     {dataflow, nodes, edges, problem}
  lines     {number, lines, skipped}          lines: {at_us, node, text, priority, event};
                                              skipped: number of lines left out before these
  acted     {number, text, problem, hint}     the result of an action
  problem   {text, hint}                      why nothing works at the moment

`dataflow` is a UUID. The page chooses `number`, and answers to its message repeat it.
"""

import json
from dataclasses import dataclass
from typing import Any

from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.logs.records import Record, record_text
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import escaped, without_sequences

TYPES = ("follow", "unfollow", "graph", "act")
ACTIONS = ("stop", "restart")
LOG_FIELDS = "MESSAGE,PRIORITY,DORA_NODE,DORA_EVENT,SYSLOG_IDENTIFIER"
MAX_TEXT = 4000
"""Maximum characters of one line for a page."""

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


def parse_message(text: str | bytes) -> PageMessage:
    """Parse a request of a page. Raises DoraSystemdError (USAGE) if it is not valid."""
    try:
        raw = json.loads(text)
        texts = {key: raw.get(key, "") for key in ("type", "dataflow", "node", "action")}
        message = PageMessage(**texts, number=int(raw.get("number", 0)))
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise _refusal() from error
    is_text = all(isinstance(one, str) for one in texts.values())
    is_known = message.type != "act" or message.action in ACTIONS
    if not is_text or message.type not in TYPES or not is_known:
        raise _refusal()
    return message


def _refusal() -> DoraSystemdError:
    hint = "the page may be of another version: reload it"
    return DoraSystemdError("cannot read what the page sent", hint, ExitCode.USAGE)


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
