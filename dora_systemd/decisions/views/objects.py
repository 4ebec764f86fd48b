"""The objects of `-o json`, described in dora-systemd-json(7). Pure.

What is unknown is None, and becomes null. Units are in the keys. A point in time has two keys:
`ended` is text in ISO 8601, `ended_us` is CLOCK_REALTIME µs. Other keys in `_us` are durations.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.releases.past import Switch
from dora_systemd.decisions.resources.usage import WHOLE_CELL
from dora_systemd.decisions.views.facts import NODE_FACTS, Fact, NodeRow
from dora_systemd.decisions.views.rows import DATAFLOW_FACTS, DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import format_moment

SCHEMA = 1
"""The version of all objects. New keys leave it; anything else makes it one more."""

Shares = Mapping[str, float]
"""The percentage of the time in which some process waited, by resource."""


def format_json(value: Any, indent: int | None = None) -> str:
    """`value` as text, in one line without `indent`; outermost objects begin with SCHEMA."""
    stamped = list(map(_stamped, value)) if isinstance(value, list) else _stamped(value)
    return json.dumps(stamped, indent=indent)


def _stamped(value: Mapping[str, Any]) -> dict[str, Any]:
    return {"schema": SCHEMA, **value}


def moment(key: str, at_us: int) -> dict[str, Any]:
    """A point in time in both forms; at_us: CLOCK_REALTIME µs, 0 is unknown."""
    if not at_us:
        return {key: None, f"{key}_us": None}
    return {key: format_moment(at_us), f"{key}_us": at_us}


def switch_object(name: str, one: Switch) -> dict[str, Any]:
    """A change of what runs for `-o json`. name: of the dataflow."""
    return {
        "name": name,
        **moment("at", one.at_us),
        "from": one.former or None,
        "to": one.release or None,
        "ended": one.how,
        "by": one.by or None,
        "reason": one.reason or None,
        "node": one.node or None,
    }


def dataflow_object(row: DataflowRow, waits: Mapping[str, Shares] | None = None) -> dict[str, Any]:
    """Return the JSON object of a dataflow with its nodes, equal in all verbs.

    waits: by node, WHOLE_CELL is the whole dataflow; only `top` knows them.
    """
    shares = waits or {}
    values = _values(DATAFLOW_FACTS, row, shares.get(WHOLE_CELL))
    if not row.nodes_total or row.problem:
        values |= {"nodes_alive": None, "nodes_total": None}
    return {**values, "nodes": [_node_object(row, one, shares.get(one.node)) for one in row.nodes]}


def _node_object(whole: DataflowRow, row: NodeRow, shares: Shares | None) -> dict[str, Any]:
    machine = row.machine or (HEAD if whole.machines else None)
    return {**_values(NODE_FACTS, row, shares), "machine": machine}


def _values(
    facts: Sequence[Fact], row: DataflowRow | NodeRow, shares: Shares | None
) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for fact in facts:
        if fact.is_moment:
            values |= moment(fact.key, fact.of(row))
        else:
            values[fact.key] = fact.value(fact.of(row))
    return values | {"waits_percent": shares or None}


def error_object(error: DoraSystemdError) -> dict[str, Any]:
    """Return the object that a failing command prints, also the `error` of an outcome."""
    return {
        "message": error.message,
        "hint": error.hint or None,
        "exit_status": int(error.code),
        "lines": list(error.lines),
    }
