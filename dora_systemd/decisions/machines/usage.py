"""The reports of members about their nodes and the nodes' usage, as the head reads them. Pure.

The head cannot read the cgroups of another machine, and a member can lie about its own nodes: the
numbers of a member are only checked to be possible.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.resources.usage import (
    CpuSample,
    Usage,
    cpu_percent,
    throttled_percent,
    usage_facts,
)
from dora_systemd.decisions.watchdog.messages import parse_sign
from dora_systemd.values import INFINITY

_MOST = INFINITY // 2
_MOST_PERCENT = 100 * 8192
"""All of the processors that Linux can have."""


class NodeUse(NamedTuple):
    """The usage of a node that runs elsewhere."""

    use: Usage
    # cpu_percent, throttled: percentages as in a NodeRow, at the time when the member has read them
    cpu_percent: float
    throttled: float

    def facts(self) -> dict[str, Any]:
        """The fields of a NodeRow."""
        return usage_facts(self.use, self.cpu_percent, self.throttled)


def told_use(use: Usage, samples: tuple[CpuSample, ...], now: CpuSample, node: str) -> list[Any]:
    """Return what a member writes into its table for parse_use(). now: the reading with `use`."""
    shares = (cpu_percent(samples, now, node), throttled_percent(samples, now, node))
    limits = (use.memory, use.memory_peak, use.memory_max, use.cpu_max)
    counters = (use.cpu_us, *use.throttling)
    # JSON has no INFINITY: no limit and no controller are shown alike.
    return [
        *(round(one, 1) for one in shares),
        *counters,
        *(one if one is not None and one < _MOST else None for one in limits),
    ]


def parse_use(raw: Any) -> NodeUse | None:
    """Parse the usage in a table that another machine has written; None if it is invalid."""
    match raw:
        case [float() as cpu, float() as throttled, used, periods, late, memory, peak, most, share]:
            are_shares = 0 <= cpu <= _MOST_PERCENT and 0 <= throttled <= 100
            are_counters = all(map(_is_number, (used, periods, late)))
            if are_shares and are_counters and all(map(_is_limit, (memory, peak, most, share))):
                use = Usage(used, memory, peak, most, share, (periods, late))
                return NodeUse(use, cpu, throttled)
    return None


def _is_number(value: object) -> bool:
    return type(value) is int and 0 <= value < _MOST


def _is_limit(value: object) -> bool:
    return value is None or _is_number(value)


def uses_of(status: CellStatus) -> dict[str, NodeUse]:
    """The usage of the nodes in the table of a head that run on members."""
    found = {node: parse_use(raw) for node, raw in status.usage.items() if _is_away(status, node)}
    return {node: one for node, one in found.items() if one is not None}


def _is_away(status: CellStatus, node: str) -> bool:
    return node in status.nodes and bool(status.nodes[node].machine)


def merged(table: CellStatus, others: Mapping[str, CellStatus]) -> CellStatus:
    """Merge the tables of members into that of the head. others: by machine, for its nodes only.

    The head receives the events of all nodes from dora. A member adds the reasons of ends, the
    counts of lines, the usage of its nodes, and the STATUS= that the nodes send.
    """
    nodes = {ident: _told(ident, node, others) for ident, node in table.nodes.items()}
    away = {ident: others[n.machine] for ident, n in table.nodes.items() if n.machine in others}
    lines = {ident: one.lines[ident] for ident, one in away.items() if ident in one.lines}
    # Only valid ones: a member must not fill the table of the head. Its clock has another zero.
    said = {node: parse_sign(one.signs[node]) for node, one in away.items() if node in one.signs}
    signs = {**table.signs, **{node: (one.status, 0, 0) for node, one in said.items()}}
    usage = {node: one.usage[node] for node, one in away.items() if parse_use(one.usage.get(node))}
    dues = {node: one.stop_dues[node] for node, one in away.items() if node in one.stop_dues}
    return table._replace(
        nodes=nodes,
        lines={**table.lines, **lines},
        usage=usage,
        signs=signs,
        stop_dues={**table.stop_dues, **dues},
    )


def _told(ident: str, node: NodeStatus, others: Mapping[str, CellStatus]) -> NodeStatus:
    other = others[node.machine].nodes.get(ident) if node.machine in others else None
    if other is None:
        return node
    has_failed = node.exit.is_failure and other.exit.is_failure
    exit = other.exit if has_failed else node.exit
    return node._replace(exit=exit, hung=other.hung, needs=other.needs)
