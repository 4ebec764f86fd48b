"""Nodes that end before they have called dora, and those that fail for it: see handlers.py. Pure.

dora then fails every node that waits at the start barrier, whatever the exit status of the first
node was. dora names the first node only in its errors about the other nodes.
"""

from collections.abc import Mapping
from dataclasses import replace

from dora_systemd.decisions.cell.exits import EARLY, Exit
from dora_systemd.decisions.cell.status import HELD, LATCHED
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Record

_ENDED = ("finished", "failed")


def is_doomed(cell: Cell) -> bool:
    """Whether dora fails a node that it will not restart, because another one has ended early."""
    waiting = (node for node in cell.nodes.values() if node.state == "ready")
    return bool(_still_ended(cell)) and any(node.policy == "never" for node in waiting)


def noted(before: Cell, after: Cell, node: str) -> Cell:
    """Add a node to `early` if it was not ready yet, and does not come back."""
    old, new = before.nodes.get(node), after.nodes[node]
    was_ready = old is not None and old.state == "ready"
    if was_ready or new.state not in _ENDED or new.policy in (HELD, LATCHED):
        return after
    return replace(after, early=(*after.early, node))


def with_cause(cell: Cell, event: life.NodeExited) -> life.NodeExited:
    """Name the node that has ended early in the exit of one that was ready."""
    ended, old = _still_ended(cell), cell.nodes.get(event.node)
    is_victim = old is not None and old.state == "ready" and event.exit.is_failure
    if not ended or not is_victim or event.will_restart or event.is_stale:
        return event
    return replace(event, exit=event.exit._replace(by=ended[0]))


def blamed(cell: Cell, event: life.NodeExited) -> tuple[Cell, tuple[Record, ...]]:
    """Count a node that has finished early as failed, as soon as another one fails for it."""
    node = cell.nodes.get(event.exit.by)
    if node is None or node.state != "finished":
        return cell, ()
    failed = node._replace(state="failed", exit=EARLY)
    record = Record("node-crashed", event.exit.by, EARLY.details())
    return replace(cell, nodes={**cell.nodes, event.exit.by: failed}), (record,)


def blamed_results(results: Mapping[str, Exit]) -> dict[str, Exit]:
    """dora's results, in which a node that others have failed for is a success."""
    causes = {how.by for how in results.values() if how.by}
    return {
        node: EARLY if node in causes and not how.is_failure else how
        for node, how in results.items()
    }


def _still_ended(cell: Cell) -> list[str]:
    return [node for node in cell.early if node in cell.nodes and cell.nodes[node].state in _ENDED]
