"""The table of a head, with what its members say of their nodes. Pure."""

from collections.abc import Mapping

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus


def merged(table: CellStatus, others: Mapping[str, CellStatus]) -> CellStatus:
    """The table of the head. others: by machine; each is believed for its own nodes only.

    The head itself hears from dora what nodes do. A member knows more of why, and counts the lines.
    """
    nodes = {ident: _told(ident, node, others) for ident, node in table.nodes.items()}
    lines = {
        ident: others[node.machine].lines[ident]
        for ident, node in table.nodes.items()
        if node.machine in others and ident in others[node.machine].lines
    }
    return table._replace(nodes=nodes, lines={**table.lines, **lines})


def _told(ident: str, node: NodeStatus, others: Mapping[str, CellStatus]) -> NodeStatus:
    other = others[node.machine].nodes.get(ident) if node.machine in others else None
    if other is None:
        return node
    has_failed = node.exit.is_failure and other.exit.is_failure
    exit = other.exit if has_failed else node.exit
    return node._replace(exit=exit, hung=other.hung, needs=other.needs)
