"""A stop in which nodes have an order and times of their own: the setting `stop`. Pure.

Each node receives the stop when those that its `after` names have ended. If it does not end within
its time it gets SIGTERM, and SIGKILL half a grace duration later, as from dora. The node gets more
time with EXTEND_TIMEOUT_USEC=, as far as `stop_limit` leaves the later nodes their time.

A stop before all nodes were ready has no order: dora would fail a node whose message is early.

With several machines the head has the order. A member stops a node when the head requests that,
and measures the time of the node. What ends a node without dora has no order: see
machines.py.
"""

from dataclasses import replace

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.cell.stops import tails, within_of
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.failures import Next
from dora_systemd.decisions.life.states import (
    Action,
    Cell,
    EndNode,
    GiveTime,
    Record,
    StopNode,
    StopStep,
)

_NOT_AWAITED = ("restarting", "dynamic")
"""States in which the stop waits for no process, although the node has not ended."""


def has_order(cell: Cell) -> bool:
    """Whether the stop of this cell has an order."""
    return bool(cell.stops) and cell.ready_us > 0 and not cell.machine


def take_turn(cell: Cell, event: life.NodeTurn) -> Next:
    """Stop a node of this member, because the head requests that."""
    status = cell.nodes.get(event.node)
    if status is None or event.node in cell.ending or _is_over(status):
        return cell, ()
    cell = replace(cell, ending={**cell.ending, event.node: StopStep.STOPPED})
    return cell, (StopNode(event.node, event.within),)


def advance(cell: Cell) -> Next:
    """Stop the nodes whose turn it is."""
    due = [node for node in cell.nodes if _is_due(cell, node)]
    if not due or not has_order(cell):
        return cell, ()
    ending = {**cell.ending, **dict.fromkeys(due, StopStep.STOPPED)}
    return replace(cell, ending=ending), tuple(_stop(cell, node) for node in due)


def _stop(cell: Cell, node: str) -> Action:
    return StopNode(node, within_of(cell.stops, node, cell.grace))


def _is_due(cell: Cell, node: str) -> bool:
    if node in cell.ending or _is_over(cell.nodes[node]):
        return False
    stop = cell.stops.get(node)
    return stop is None or all(_has_ended(cell, one) for one in stop.after)


def _is_over(status: NodeStatus) -> bool:
    return status.state in ("failed", "finished") or (status.state == "stopped" and not status.pid)


def _has_ended(cell: Cell, node: str) -> bool:
    status = cell.nodes.get(node)
    if status is None or cell.ending.get(node) is StopStep.KILLED:
        return True
    return _is_over(status) or status.state in _NOT_AWAITED


def overdue(cell: Cell, event: life.NodeOverdue) -> Next:
    """End a node that has used up its time: by SIGTERM, the next time by SIGKILL."""
    step, status = cell.ending.get(event.node), cell.nodes.get(event.node)
    if status is None or _is_over(status) or step not in (StopStep.STOPPED, StopStep.TERMINATED):
        return cell, ()
    after = StopStep.TERMINATED if step is StopStep.STOPPED else StopStep.KILLED
    cell = replace(cell, ending={**cell.ending, event.node: after})
    if after is StopStep.TERMINATED:
        late = Record("node-stop-late", event.node)
        return cell, (late, EndNode(event.node, after=cell.grace // 2))
    cell, more = advance(cell)
    return cell, (EndNode(event.node), *more)


def extend(cell: Cell, event: life.NodeExtends) -> Next:
    """Give a node more time, if it has a time of its own and nothing has ended it yet."""
    stop = cell.stops.get(event.node)
    if not (stop and stop.within) or cell.ending.get(event.node) is not StopStep.STOPPED:
        return cell, ()
    most = most_time(cell, event.node, event.passed_us)
    return cell, (GiveTime(event.node, min(event.wanted, most)),) if most > 0 else ()


def most_time(cell: Cell, node: str, passed: int) -> int:
    """µs until SIGTERM that a node may have now at most. passed: µs since the stop began."""
    tail = tails(cell.stops, cell.grace).get(node, 0)
    return cell.stop_limit - tail - cell.grace // 2 - passed


def in_turn(cell: Cell) -> tuple[list[str], list[str]]:
    """The nodes that are stopping, and those that follow them."""
    left = {node: one for node, one in cell.nodes.items() if not _has_ended(cell, node)}
    now = [node for node in left if node in cell.ending]
    return now, [node for node in left if node not in cell.ending]
