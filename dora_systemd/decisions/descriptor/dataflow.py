"""The part of a dataflow descriptor that we read. All else in it is dora's business, kept as is.

The checks give the mistakes that dora reports in ten lines, or not at all, one line each: `nodes:
[]` would run for ever, and an input from nowhere is found by `dora validate` only. dora has the
last word on everything else.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.descriptor.json_size import check_json
from dora_systemd.decisions.descriptor.nodes import (
    UNEXPANDED,
    Node,
    NodeKind,
    dataflow_refusal,
    described,
    mapping_of,
    parse_node,
)
from dora_systemd.values import quoted

MAX_JSON = 1024 * 1024 - 4096
"""Bytes of a descriptor as JSON: dora refuses a control frame above 1 MiB, all of it included."""

_DORA_SOURCES = "dora/"


@dataclass(frozen=True)
class Dataflow:
    """A descriptor: `source` names its file in messages, `raw` is the whole mapping."""

    source: str
    nodes: tuple[Node, ...]
    env: Mapping[str, object]
    exit_when_nodes_finish: bool | None
    raw: Mapping[str, object] = field(repr=False)

    def node(self, node_id: str) -> Node | None:
        """The node of that id, or None."""
        return next((node for node in self.nodes if node.id == node_id), None)


def parse_dataflow(document: object, source: str) -> Dataflow:
    """The dataflow in an already loaded YAML or JSON document; `source` names it in errors.

    Raises DoraSystemdError (BAD_INPUT) with file and node when there is no node, an id is double
    or one that dora refuses, an input comes from nowhere, something has a type that dora cannot
    read, or all of it is more than one control frame of dora can carry (1 MiB as JSON).
    """
    if not isinstance(document, dict):
        hint = "a dataflow is a mapping with the key 'nodes'"
        raise dataflow_refusal(source, f"it holds {described(document)}", hint)
    check_json(document, source, MAX_JSON)
    nodes = document.get("nodes")
    if not nodes or not isinstance(nodes, list):
        reason = "it has no nodes" if not nodes else f"'nodes' is {described(nodes)}"
        raise dataflow_refusal(source, reason, "list at least one node below 'nodes:'")
    parsed = tuple(parse_node(node, place, source) for place, node in enumerate(nodes))
    exits = document.get("exit_when_nodes_finish")
    dataflow = Dataflow(
        source=source,
        nodes=parsed,
        env=mapping_of(document.get("env"), source, "'env'"),
        exit_when_nodes_finish=exits if isinstance(exits, bool) else None,
        raw=document,
    )
    _check_ids(dataflow)
    _check_wiring(dataflow)
    return dataflow


def _check_ids(dataflow: Dataflow) -> None:
    seen: set[str] = set()
    for node in dataflow.nodes:
        if node.id in seen:
            hint = "every node needs an id of its own"
            raise dataflow_refusal(dataflow.source, f"two nodes have the id {node.id}", hint)
        seen.add(node.id)


def _check_wiring(dataflow: Dataflow) -> None:
    nodes = {node.id: node for node in dataflow.nodes}
    for node in dataflow.nodes:
        for given in node.inputs:
            reason = _missing(given.source, nodes)
            if reason:
                hint = "an input comes from NODE/OUTPUT, where NODE lists OUTPUT in its outputs"
                where = f"node {node.id}: input {quoted(given.name)} comes from"
                raise dataflow_refusal(
                    dataflow.source, f"{where} {quoted(given.source)}, {reason}", hint
                )


def _missing(source: str, nodes: Mapping[str, Node]) -> str:
    """What is wrong with the source of an input, or ""."""
    origin, slash, output = source.partition("/")
    if source.startswith(_DORA_SOURCES):
        return ""
    if not slash:
        return "which names no output"
    if origin not in nodes:
        # An expanded module's nodes are called MODULE.NODE.
        is_inside = nodes.get(origin.partition(".")[0])
        return "" if is_inside and is_inside.kind in UNEXPANDED else "a node that does not exist"
    node = nodes[origin]
    # ros2 nodes get outputs from their topics.
    if node.kind in UNEXPANDED or node.kind == NodeKind.ROS2 or output in node.outputs:
        return ""
    return "an output that it does not declare"
