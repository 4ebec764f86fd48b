"""Finds the nodes that get no more input when a node is gone."""

from collections.abc import Mapping

from dora_systemd.decisions.descriptor.dataflow import Dataflow

Downstream = Mapping[str, tuple[str, ...]]
"""Node id -> the nodes that depend on its outputs, nearest first."""


def downstream_of(dataflow: Dataflow) -> Downstream:
    """The nodes downstream of each node, directly or indirectly; a circle ends at its start."""
    takers: dict[str, list[str]] = {node.id: [] for node in dataflow.nodes}
    for node in dataflow.nodes:
        for origin in {one.source.partition("/")[0] for one in node.inputs}:
            takers.setdefault(origin, []).append(node.id)
    return {node.id: _reached(node.id, takers) for node in dataflow.nodes}


def _reached(start: str, takers: Mapping[str, list[str]]) -> tuple[str, ...]:
    found, waiting = {start}, [start]
    for node in waiting:  # the list grows during the loop
        new = [one for one in takers.get(node, ()) if one not in found]
        found.update(new)
        waiting += new
    return tuple(waiting[1:])
