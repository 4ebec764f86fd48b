"""The table of a head, with what its members say of their nodes. Pure."""

from collections.abc import Mapping

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.machines.usage import parse_use
from dora_systemd.decisions.signs.table import parse_sign


def merged(table: CellStatus, others: Mapping[str, CellStatus]) -> CellStatus:
    """The table of the head. others: by machine; each is believed for its own nodes only.

    The head itself hears from dora what nodes do. A member knows more of why, counts the lines,
    reads what its nodes use, and hears what they say of themselves.
    """
    nodes = {ident: _told(ident, node, others) for ident, node in table.nodes.items()}
    away = {ident: others[n.machine] for ident, n in table.nodes.items() if n.machine in others}
    lines = {ident: one.lines[ident] for ident, one in away.items() if ident in one.lines}
    # Not what is none: a member must not fill the table of the head. Its clock has another zero.
    said = {node: parse_sign(one.signs[node]) for node, one in away.items() if node in one.signs}
    signs = {**table.signs, **{node: (one.status, 0, 0) for node, one in said.items()}}
    usage = {node: one.usage[node] for node, one in away.items() if parse_use(one.usage.get(node))}
    return table._replace(nodes=nodes, lines={**table.lines, **lines}, usage=usage, signs=signs)


def _told(ident: str, node: NodeStatus, others: Mapping[str, CellStatus]) -> NodeStatus:
    other = others[node.machine].nodes.get(ident) if node.machine in others else None
    if other is None:
        return node
    has_failed = node.exit.is_failure and other.exit.is_failure
    exit = other.exit if has_failed else node.exit
    return node._replace(exit=exit, hung=other.hung, needs=other.needs)
