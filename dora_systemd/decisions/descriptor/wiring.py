"""Which nodes get nothing any more when one of them is gone."""

from collections.abc import Mapping

from dora_systemd.decisions.descriptor.dataflow import Dataflow

Downstream = Mapping[str, tuple[str, ...]]
"""Node id -> the nodes that live on what it sends, near ones first."""

_FAILURES = ("node-crashed", "node-oom")


def downstream_of(dataflow: Dataflow) -> Downstream:
    """The nodes that each node feeds, directly or through others; circles end where they began."""
    takers: dict[str, list[str]] = {node.id: [] for node in dataflow.nodes}
    for node in dataflow.nodes:
        for origin in {one.source.partition("/")[0] for one in node.inputs}:
            takers.setdefault(origin, []).append(node.id)
    return {node.id: _reached(node.id, takers) for node in dataflow.nodes}


def _reached(start: str, takers: Mapping[str, list[str]]) -> tuple[str, ...]:
    found = [start]
    for node in found:  # grows on the way
        found += [one for one in takers.get(node, ()) if one not in found]
    return tuple(found[1:])


def with_downstream(
    record: tuple[str, str, Mapping[str, str]], downstream: Downstream
) -> tuple[str, str, Mapping[str, str]]:
    """Name, node and details of a life event; those of a failed node say whom it starves."""
    event, node, details = record
    fed = downstream.get(node)
    if event not in _FAILURES or not fed:
        return record
    return event, node, {**details, "downstream": " ".join(fed)}
