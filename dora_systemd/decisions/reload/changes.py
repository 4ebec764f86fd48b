"""What must restart after files have changed: as little as possible; the steps for dora. Pure."""

import json
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.reload.watch_rules import WatchRules

_EDGES = ("inputs", "outputs", "operator", "operators", "ros2")
"""Keys of a node that dora cannot change in place."""


class NodeSources(NamedTuple):
    """The files of one node."""

    # absolute paths of its program and the modules that it imports
    files: frozenset[str] = frozenset()
    text: str = ""  # its whole definition, which may contain names of configuration files
    rules: WatchRules | None = None  # its own `watch` patterns
    fresh: frozenset[str] = frozenset()  # the files that the node runs in their present version


class Touched(NamedTuple):
    """Nodes affected by changed files, each with the first of these files."""

    nodes: Mapping[str, str] = {}
    descriptor: bool = False  # whether the dataflow file itself has changed


def touched(changed: Iterable[str], dataflow: str, nodes: Mapping[str, NodeSources]) -> Touched:
    """The nodes that the files `changed` affect.

    A file of a program affects the nodes that run another version of it. Any other file affects
    the nodes that watch or mention it; if there are none, it affects all nodes, because each may
    read it.
    """
    found: dict[str, str] = {}
    paths = sorted(changed)
    for path in paths:
        if path != dataflow:
            for node in _owners(path, nodes):
                found.setdefault(node, path)
    return Touched(found, dataflow in paths)


def _owners(path: str, nodes: Mapping[str, NodeSources]) -> list[str]:
    owners = [
        node
        for node, sources in nodes.items()
        if path in sources.files or (sources.rules is not None and sources.rules.has(path))
    ]
    if owners or path.endswith(".py"):
        return [node for node in owners if path not in nodes[node].fresh]
    name = PurePath(path).name
    return [node for node, sources in nodes.items() if name in sources.text] or list(nodes)


class Difference(NamedTuple):
    """The differences of a descriptor, as node ids."""

    replaced: tuple[str, ...] = ()  # nodes with changes other than inputs and outputs
    rewired: tuple[str, ...] = ()  # nodes with other inputs or outputs, and no readers
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    whole: str = ""  # why the dataflow as a whole must restart, or ""

    @property
    def is_empty(self) -> bool:
        """Whether nothing has changed for dora."""
        return self == Difference()


def difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> Difference:
    """The differences between two expanded descriptors.

    dora can add, remove and replace nodes of a running dataflow. A replaced node keeps its edges; a
    node with other edges must be removed and added, which would end the nodes that read from it.
    dora reads keys other than `nodes` only at the start.
    """
    if _without_nodes(old) != _without_nodes(new):
        return Difference(whole="keys of the dataflow itself have changed")
    before, after = _by_id(old["nodes"]), _by_id(new["nodes"])
    changed = [node for node in after if node in before and after[node] != before[node]]
    rewired = tuple(node for node in changed if _edges(before[node]) != _edges(after[node]))
    for node in rewired:
        if has_readers(node, before.values()) or has_readers(node, after.values()):
            return Difference(whole=f"inputs or outputs of the node {node} have changed")
    added = tuple(node for node in after if node not in before)
    for node in (*added, *changed):
        if after[node].get("operator") or after[node].get("operators"):
            return Difference(whole=f"the node {node} is made of operators")
    return Difference(
        replaced=tuple(node for node in changed if node not in rewired),
        rewired=rewired,
        added=added,
        removed=tuple(node for node in before if node not in after),
    )


def has_readers(node: str, nodes: Iterable[Mapping[str, Any]]) -> bool:
    """Whether another one of `nodes` has an input from this node, in any of its notations."""
    source = json.dumps(f"{node}/")[:-1]
    return any(source in json.dumps(one) for one in nodes if one.get("id") != node)


def _without_nodes(descriptor: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in descriptor.items() if key != "nodes"}


def _edges(node: Mapping[str, Any]) -> list[Any]:
    return [node.get(key) for key in _EDGES]


def _by_id(nodes: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {str(node["id"]): node for node in nodes}


class How(Enum):
    """What happens to a node."""

    REMOVE = "removed"
    REWIRE = "reconnected"
    SWAP = "reloaded"
    OPERATOR = "reloaded in place"
    ADD = "added"


class Step(NamedTuple):
    """One node, and the reason: the absolute path of a changed file."""

    how: How
    node: str
    file: str


def plan_steps(
    found: Touched, change: Difference, kinds: Mapping[str, str], dataflow: str
) -> tuple[Step, ...]:
    """The steps in order, one for each node, without dynamic nodes, which dora does not start.

    kinds: how each node is started, see launch.kinds(). dataflow: path of its file.
    """
    changed = {How.REMOVE: change.removed, How.REWIRE: change.rewired, How.SWAP: change.replaced}
    steps = [Step(how, node, dataflow) for how, nodes in changed.items() for node in nodes]
    done = {step.node for step in steps}.union(change.added)
    for node, file in found.nodes.items():
        if node not in done and kinds.get(node) != "dynamic":
            how = How.OPERATOR if kinds.get(node) == "operator" else How.SWAP
            steps.append(Step(how, node, file))
    return (*steps, *(Step(How.ADD, node, dataflow) for node in change.added))
