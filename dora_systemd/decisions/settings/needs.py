"""The setting `needs`: what has to be there before the dataflow, or one node, starts."""

from collections.abc import Sequence
from operator import add

from dora_systemd.decisions.cell.launch import is_launched
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.needs.words import (
    FOREIGN,
    check_needs,
    needs_of,
    parse_needs,
    parse_node_needs,
)
from dora_systemd.decisions.settings.kinds import Setting, many_texts


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
    "What to wait for: network, clock, dataflow:NAME, unit:NAME or mount:PATH.",
    per_node=True,
    node_kind=many_texts("a path, net:INTERFACE, or a list of them", "", parse_node_needs, list),
    raises=lambda needs: any(one.startswith(FOREIGN) for one in needs),
    outlives_node=True,
    check=_check,
)
NEED_SETTINGS = (NEEDS,)
RUNNER_SETTINGS = {NEEDS.name: NEEDS}
