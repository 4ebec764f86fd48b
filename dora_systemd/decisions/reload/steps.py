"""Plans the steps by which dora applies a changed descriptor to a running dataflow."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

from dora_systemd.decisions.reload.changes import Difference, Touched


class How(Enum):
    """What happens to a node."""

    REMOVE = "removed"
    REWIRE = "reconnected"
    SWAP = "reloaded"
    OPERATOR = "reloaded in place"
    ADD = "added"


@dataclass(frozen=True)
class Step:
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
    return tuple(_steps(found, change, kinds, dataflow))


def _steps(
    found: Touched, change: Difference, kinds: Mapping[str, str], dataflow: str
) -> Iterator[Step]:
    for node in change.removed:
        yield Step(How.REMOVE, node, dataflow)
    for node in change.rewired:
        yield Step(How.REWIRE, node, dataflow)
    for node in change.replaced:
        yield Step(How.SWAP, node, dataflow)
    done = {*change.removed, *change.rewired, *change.replaced}
    for node, file in found.nodes.items():
        if node not in done and kinds.get(node) != "dynamic":
            yield Step(How.OPERATOR if kinds.get(node) == "operator" else How.SWAP, node, file)
    for node in change.added:
        yield Step(How.ADD, node, dataflow)
