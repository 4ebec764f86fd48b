"""The setting `needs`: what has to be there before the dataflow, or one node, starts."""

from collections.abc import Mapping, Sequence
from operator import add

from dora_systemd.decisions.cell.launch import is_launched
from dora_systemd.decisions.cell.needs import (
    FOREIGN,
    check_needs,
    needs_by_node,
    needs_of,
    parse_needs,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.settings.kinds import Setting, many_texts


def _by_node(
    nodes: Mapping[str, tuple[str, ...]], given: tuple[str, ...]
) -> dict[str, dict[str, tuple[str, ...]]]:
    return {node: {"needs": needs} for node, needs in needs_by_node(given, nodes).items()}


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    check_needs(needs_of(options), {node.id for node in nodes if is_launched(node)})


NEEDS = Setting[tuple[str, ...]](
    "needs",
    many_texts(
        "network, clock, dataflow:NAME, unit:NAME, mount:PATH, or a list of them; for a node "
        "paths and net:INTERFACE",
        "NEED",
        parse_needs,
        list,
        add,
    ),
    (),
    "What to wait for: network, clock, dataflow:NAME, unit:NAME, mount:PATH, NODE=PATH, or "
    "NODE=net:INTERFACE.",
    per_node=True,
    raises=lambda needs: any(one.startswith(FOREIGN) for one in needs),
    outlives_node=True,
    by_node=_by_node,
    check=_check,
)
NEED_SETTINGS = (NEEDS,)
RUNNER_SETTINGS = {NEEDS.name: NEEDS}
