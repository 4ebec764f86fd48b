"""The handlers of what ends a dataflow whose nodes have been ready, see handlers.py."""

from dataclasses import replace

from dora_systemd.decisions.cell.owed import FAIL
from dora_systemd.decisions.cell.status import HELD, LATCHED, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life import nodes as table
from dora_systemd.decisions.life.causes import ESSENTIAL, Cause
from dora_systemd.decisions.life.failures import Next, because
from dora_systemd.decisions.life.handlers import node_event, note_reload, wind_down
from dora_systemd.decisions.life.states import Action, Cell, RunnerExit


def node_exited(cell: Cell, event: life.NodeExited) -> Next:
    """A node exited: end the dataflow if it is essential and has failed for good."""
    after, actions = node_event(cell, event)
    before = cell.nodes.get(event.node)
    if before is None or not event.is_essential or _is_replaced(cell, before):
        return after, actions
    return _without(after, event.node, actions) if _is_lost(after, event.node) else (after, actions)


def reload_noted(cell: Cell, event: life.ReloadNoted) -> Next:
    """A reload is over: end the dataflow if it has failed, and left an essential node failed."""
    after, actions = note_reload(cell, event)
    lost = [node for node in event.essential if _is_lost(after, node)]
    return _without(after, lost[0], actions) if lost else (after, actions)


def node_reloading(cell: Cell, event: life.Event) -> Next:
    """A reload replaces or adds a node: what the one before has reported is not true any more."""
    return node_event(replace(cell, notice=""), event)


def _is_replaced(cell: Cell, node: NodeStatus) -> bool:
    """Whether this is the first process after a reload: the reloader goes back if it fails.

    While the dataflow runs, only such a process has never been ready and is no restart of dora's.
    With a notice the reload is over: the process was too slow for it. After a restart that somebody
    asked for nothing goes back.
    """
    return node.state == "starting" and not (node.restarts or cell.notice or node.asked)


def _is_lost(cell: Cell, ident: str) -> bool:
    """Whether a node has failed for good.

    With the policy HELD it waits for a reload. With LATCHED it is not clear yet: a device that it
    needs may be gone, and if not, its launcher exits in its place.
    """
    node = cell.nodes.get(ident)
    return node is not None and node.state == "failed" and node.policy not in (HELD, LATCHED)


def _without(cell: Cell, node: str, actions: tuple[Action, ...]) -> Next:
    """The dataflow ends because of this essential node.

    Without restarts left the unit is not restarted either: that would be more than the policy says.
    """
    spent = table.spent(cell.nodes)
    reason = f"{ESSENTIAL}node {node}: {spent.get(node) or cell.nodes[node].exit}"
    code = RunnerExit.NODES_FAILED if node in spent else RunnerExit.FAILED
    cell = because(cell, Cause.NODE_FAILED, [node])
    return wind_down(replace(cell, failure=reason, exit=code), *actions)


def silent(cell: Cell, event: life.NodeSilent) -> Next:
    """A node owes an output: record it, and end the dataflow if that is asked."""
    cell, actions = node_event(cell, event)
    if event.then != FAIL:
        return cell, actions
    reason = f"node {event.node}: {event.reason}"
    cell = replace(because(cell, Cause.NODE_SILENT, [event.node]), failure=reason)
    cell = replace(cell, exit=RunnerExit.FAILED)
    return wind_down(cell, *actions)
