"""The table of a head, with what its members say of their nodes. Pure."""

from collections.abc import Mapping

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.machines.usage import parse_use


def merged(table: CellStatus, others: Mapping[str, CellStatus]) -> CellStatus:
    """The table of the head. others: by machine; each is believed for its own nodes only.

    The head itself hears from dora what nodes do. A member knows more of why, counts the lines, and
    reads what its nodes use.
    """
    nodes = {ident: _told(ident, node, others) for ident, node in table.nodes.items()}
    away = {ident: others[n.machine] for ident, n in table.nodes.items() if n.machine in others}
    lines = {ident: one.lines[ident] for ident, one in away.items() if ident in one.lines}
    # Not what is none: a member must not fill the table of the head.
    usage = {node: one.usage[node] for node, one in away.items() if parse_use(one.usage.get(node))}
    return table._replace(nodes=nodes, lines={**table.lines, **lines}, usage=usage)


def _told(ident: str, node: NodeStatus, others: Mapping[str, CellStatus]) -> NodeStatus:
    other = others[node.machine].nodes.get(ident) if node.machine in others else None
    if other is None:
        return node
    has_failed = node.exit.is_failure and other.exit.is_failure
    exit = other.exit if has_failed else node.exit
    return node._replace(exit=exit, hung=other.hung, needs=other.needs)
