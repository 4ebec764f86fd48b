"""Plans the steps by which dora applies a changed descriptor to a running dataflow."""

from collections.abc import Mapping
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
    changed = {How.REMOVE: change.removed, How.REWIRE: change.rewired, How.SWAP: change.replaced}
    steps = [Step(how, node, dataflow) for how, nodes in changed.items() for node in nodes]
    done = {step.node for step in steps}.union(change.added)
    for node, file in found.nodes.items():
        if node not in done and kinds.get(node) != "dynamic":
            how = How.OPERATOR if kinds.get(node) == "operator" else How.SWAP
            steps.append(Step(how, node, file))
    return (*steps, *(Step(How.ADD, node, dataflow) for node in change.added))
