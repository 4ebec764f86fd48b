"""The objects of `-o json`, described in dora-systemd-json(7). Pure.

What is unknown is None, and becomes null. Units are in the keys. A point in time has two keys:
`ended` is text in ISO 8601, `ended_us` is CLOCK_REALTIME µs. Other keys in `_us` are durations.
"""

import json
from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.cell.counters import WHOLE_CELL
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.releases.past import Switch
from dora_systemd.decisions.views.facts import NODE_FACTS, USAGE, NodeRow
from dora_systemd.decisions.views.inhibitors import holder_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import format_moment

SCHEMA = 1
"""The version of all objects. New keys leave it; anything else makes it one more."""

Shares = Mapping[str, float]
"""By resource, the percentage of the time in which some process waited for it."""


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
    """A dataflow with its nodes, the same wherever one is printed.

    waits: by node, WHOLE_CELL is the whole dataflow; only `top` knows them.
    """
    shares = waits or {}
    is_counted = row.nodes_total and not row.problem
    return {
        "name": row.name,
        "uuid": row.uuid,
        "unit": row.unit,
        "file": row.dataflow or None,
        "release": row.release or None,
        "status": row.status,
        "waits_for": row.needs or None,
        **moment("waits_since", row.waits_since),
        "text": row.text or None,
        "problem": row.problem or None,
        "enabled": row.enabled,
        "inhibitors": list(map(holder_object, row.inhibitors)),
        "uptime_us": row.uptime,
        **moment("started", row.started),
        **moment("ready", row.ready),
        **moment("ended", row.ended),
        "nodes_alive": row.nodes_alive if is_counted else None,
        "nodes_total": row.nodes_total if is_counted else None,
        **{one.key: one.of(row) for one in USAGE},
        "waits_percent": shares.get(WHOLE_CELL) or None,
        "restarts": row.restarts,
        "restart_budget": row.restart_budget,
        "machine": row.machine or None,
        "machines": list(row.machines),
        "nodes": [_node_object(row, one, shares.get(one.node)) for one in row.nodes],
    }


def _node_object(whole: DataflowRow, row: NodeRow, shares: Shares | None) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for fact in NODE_FACTS:
        value = fact.value(fact.of(row))
        values |= moment(fact.key, value) if fact.is_moment else {fact.key: value}
    machine = row.machine or (HEAD if whole.machines else None)
    return {**values, "machine": machine, "waits_percent": shares or None}


def error_object(error: DoraSystemdError) -> dict[str, Any]:
    """What a command that fails prints, and the `error` of an outcome."""
    return {
        "message": error.message,
        "hint": error.hint or None,
        "exit_status": int(error.code),
        "lines": list(error.lines),
    }
