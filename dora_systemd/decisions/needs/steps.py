"""Steps for nodes whose needs are missing or exist again. Pure."""

from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from dora_systemd.decisions.cell.status import HELD, LATCHED, NodeStatus, is_stopped

_WITH_PROGRAM = ("starting", "ready", "running", "restarting")


class Do(Enum):
    """The step to take for a node."""

    HOLD = "wait"
    """The launcher of the node waits already: only show the wait."""
    LOSE = "end it"
    """End its process; the next one waits."""
    LET_GO = "go on"
    """Open its gate."""
    GIVE_UP = "give it up"
    """The node has no restarts left, and what it needs exists: the node itself has failed."""


class NeedStep(NamedTuple):
    """One step."""

    do: Do
    node: str
    needs: str = ""  # what the node waits for (human-readable)


def need_steps(
    nodes: Mapping[str, NodeStatus],
    missing: Mapping[str, str],
    is_running: bool,
    passed: frozenset[str],
) -> Iterator[NeedStep]:
    """The steps for the nodes with needs.

    missing: by node with needs, what is missing, or "". is_running: whether dora has opened its
    start barrier. passed: the nodes whose gate is open.
    """
    if is_running:
        for node in missing.keys() & nodes.keys():
            yield from _step(node, nodes[node], missing[node], node in passed)
        return
    # dora starts all nodes together: a node that starts early would only wait elsewhere, and could
    # lose its device meanwhile, which dora counts as a failed start.
    lacking = [
        node
        for node, what in missing.items()
        if what and not is_stopped(nodes.get(node, NodeStatus()))
    ]
    for node in sorted(missing.keys() & nodes.keys() - passed):
        if nodes[node].state in ("starting", "waiting"):
            yield from _step_before(node, nodes[node], missing[node], lacking)


def _step_before(
    node: str, status: NodeStatus, missing: str, lacking: Sequence[str]
) -> Iterator[NeedStep]:
    if not lacking:
        yield NeedStep(Do.LET_GO, node)
        return
    needs = missing or f"node {lacking[0]}"
    if status.needs != needs:
        yield NeedStep(Do.HOLD, node, needs)


def _step(node: str, status: NodeStatus, missing: str, is_open: bool) -> Iterator[NeedStep]:
    is_down = status.state == "failed" and status.policy in (HELD, LATCHED)
    if status.state == "waiting" or (not is_open and status.state in ("starting", "reloading")):
        if not missing:
            yield NeedStep(Do.LET_GO, node)
        elif status.needs != missing:
            yield NeedStep(Do.HOLD, node, missing)
    elif missing and (status.state in _WITH_PROGRAM or is_down):
        yield NeedStep(Do.LOSE, node, missing)
    elif is_down and status.policy == LATCHED and is_open:
        yield NeedStep(Do.GIVE_UP, node)
