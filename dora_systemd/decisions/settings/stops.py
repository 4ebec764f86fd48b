"""The settings of a stop: the time and the order of nodes, and the limit of all together."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.stops import (
    KEYS,
    NodeStop,
    check_stops,
    format_node_stop,
    named_stops,
    parse_node_stop,
    stop_of,
)
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.settings.kinds import DURATION, Base, Kind, Scalar, Setting, texts_of
from dora_systemd.decisions.settings.owes import check_sockets
from dora_systemd.values import SECOND, scalar_text

DEFAULT_STOP_LIMIT = 300 * SECOND
"""µs."""


def _parse(value: Any, _: Base) -> NodeStop:
    if not isinstance(value, Mapping):
        text = scalar_text(value)
        return parse_node_stop(text if "=" in text else f"within={text}")
    return stop_of(
        {key: texts_of(one) if key == "after" else scalar_text(one) for key, one in value.items()}
    )


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    stops, limit = named_stops(options.by_node("stop")), options.of_dataflow("stop_limit")
    check_stops(stops.values(), limit, options.grace, [node.id for node in nodes])
    check_sockets(options, nodes)


STOP = Setting[NodeStop | None](
    "stop",
    Kind[NodeStop](
        Scalar | dict[str, Scalar | list[str]],
        "{within: 60s, after: [NODE, ...]}, or one of the two",
        _parse,
        lambda stop: [format_node_stop(stop)],
        keys=KEYS,
    ),
    None,
    "Time that the node has to stop, and the nodes that stop before it.",
    only_nodes=True,
    on_head=True,
    check=_check,
)
STOP_LIMIT = Setting[int](
    "stop_limit",
    replace(DURATION, metavar="TIME"),
    DEFAULT_STOP_LIMIT,
    "Longest stop of a dataflow in which nodes have a `stop`, extensions included.",
    root_only=True,
)
STOP_SETTINGS: tuple[Setting[Any], ...] = (STOP, STOP_LIMIT)

RUNNER_SETTINGS = {one.name: one for one in STOP_SETTINGS}
