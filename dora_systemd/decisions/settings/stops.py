"""The settings of a stop: the time and the order of nodes, and the limit of all together."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dora_systemd.decisions.cell.options import DEFAULT_STOP_LIMIT
from dora_systemd.decisions.cell.stops import NodeStop, format_node_stop, parse_node_stop, stop_of
from dora_systemd.decisions.settings.kinds import DURATION, Base, Kind, Scalar, Setting, texts_of
from dora_systemd.values import scalar_text


def _parse(value: Any, _: Base) -> NodeStop:
    if not isinstance(value, Mapping):
        text = scalar_text(value)
        return parse_node_stop(f":{text}" if "=" in text else f":within={text}")
    return stop_of(
        {key: texts_of(one) if key == "after" else scalar_text(one) for key, one in value.items()}
    )


STOP = Setting[NodeStop | None](
    "stop",
    Kind[NodeStop](
        Scalar | dict[str, Scalar | list[str]],
        "{within: 60s, after: [NODE, ...]}, or one of the two",
        _parse,
        lambda stop: [format_node_stop(stop).removeprefix(":")],
    ),
    None,
    "Time that the node has to stop, and the nodes that stop before it.",
    only_nodes=True,
)
STOP_LIMIT = Setting[int](
    "stop_limit",
    replace(DURATION, metavar="TIME"),
    DEFAULT_STOP_LIMIT,
    "Longest stop of a dataflow in which nodes have a `stop`, extensions included.",
    root_only=True,
)
STOP_SETTINGS: tuple[Setting[Any], ...] = (STOP, STOP_LIMIT)


def stops_of(nodes: Mapping[str, NodeStop | None]) -> tuple[NodeStop, ...]:
    """The stops of the nodes that settings files give one."""
    return tuple(stop._replace(node=node) for node, stop in nodes.items() if stop)
