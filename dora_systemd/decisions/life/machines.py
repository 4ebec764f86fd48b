"""Handlers of events that only a dataflow with several machines has, see handlers.py.

A lost machine is a lost run: dora cannot continue without one of its daemons, and a Stop then takes
half a minute. So each machine ends its own nodes. If the stop has an order, the head keeps it for
the machines that are left: dora stops single nodes of these.

With a restart policy the head waits for the machine, and starts the next run in the same process: a
restart by systemd would use up StartLimitBurst=, and lengthen the delay of the next restart. The
failure of a part is a failure of the dataflow, which systemd restarts.
"""

from dataclasses import replace

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life import handlers as handle
from dora_systemd.decisions.life import node_table as table
from dora_systemd.decisions.life import stop_order
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.failures import (
    ENGINE_TIMEOUT,
    Next,
    because,
    engine_deadline,
    fail,
    to,
)
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import (
    Action,
    Cell,
    Deadline,
    Do,
    Record,
    State,
)
from dora_systemd.decisions.life.stop_budget import ANSWER_MARGIN, LEAVE_TIMEOUT, stop_timeout
from dora_systemd.values import SECOND

_ENDED = ("failed", "finished", "stopped", "dynamic")


def boot_deadline(cell: Cell, event: life.DeadlinePassed) -> Next:
    """Fail, because the first step timed out. For a member: the head has not sent its Part."""
    if not cell.machine:
        return engine_deadline(cell, event)
    reason = f"no head has said what to run within {ENGINE_TIMEOUT // SECOND} s"
    return fail(because(cell, Cause.NO_ANSWER), reason, RunnerExit.FAILED)


def joined(cell: Cell, event: life.DaemonConnected) -> Next:
    """Wait for the other machines, if there are any, after the daemon has registered."""
    if not cell.members and not cell.machine:
        return handle.joined(cell, event)
    return to(cell, State.GATHERING, Do.GATHER)


def awaited(cell: Cell, event: life.MachinesAwaited) -> Next:
    """Show which members are missing."""
    return replace(cell, awaited=event.text), ()


def gathered(cell: Cell, event: life.Gathered) -> Next:
    """Send the descriptor, because all machines have joined."""
    return handle.joined(replace(cell, awaited=""), life.DaemonConnected(event.at_us))


def found(cell: Cell, event: life.RunStarted) -> Next:
    """Subscribe to the events of the head's run, which this member joins."""
    cell = replace(cell, run=event.run, awaited="")
    return to(cell, State.STARTING, Do.SUBSCRIBE, after=ENGINE_TIMEOUT)


def machine_joined(cell: Cell, event: life.MachineJoined) -> Next:
    """Record that a member has joined, and can run nodes."""
    name = "machine-back" if event.machine in cell.lost else "machine-joined"
    return cell, (Record(name, "", {"machine": event.machine}),)


def machine_away(cell: Cell, event: life.MachineLost) -> Next:
    """Wait for a member that had joined and is lost, before the run has started.

    A member that was stopped on its machine fails the start: waiting would only restart it.
    """
    if event.by:
        cell = _stopped_there(cell, event)
        failed, actions = fail(cell, cell.failure, cell.exit)
        return failed, (_lost(event.machine, event.reason), *actions)
    lost = cell.lost | {event.machine}
    return replace(cell, lost=lost), (_lost(event.machine, event.reason),)


def take_other_ports(cell: Cell, event: life.ReloadAsked) -> Next:
    """End this run for the next one with other ports, because a machine has used ports of it."""
    return handle.leave_now(replace(cell, reload=True), event)


def _lost(machine: str, reason: str) -> Record:
    return Record("machine-lost", "", {"machine": machine, "reason": reason})


def machine_lost(cell: Cell, event: life.MachineLost) -> Next:
    """End the nodes of this machine, because the run is lost with the member."""
    if event.by:
        cell = _stopped_there(cell, event)
    elif cell.waits_for_lost and not event.is_failure:
        cell = replace(cell, reload=True, lost=cell.lost | {event.machine})
    else:
        cell = because(cell, Cause.MACHINE_LOST)
        failure = f"machine {event.machine}: {event.reason}"
        cell = replace(cell, failure=failure, exit=RunnerExit.ENGINE_LOST)
    return _without_machine(cell, event)


def _without_machine(cell: Cell, event: life.MachineLost) -> Next:
    """End the nodes, in their order if they have one."""
    lost = _lost(event.machine, event.reason)
    if not stop_order.has_order(cell):
        return _end_nodes(cell, event, lost)
    if not event.is_waiting:
        cell = replace(cell, nodes=_without_others(cell, event.at_us, event.machine))
    if cell.state is State.STOPPING:  # its deadline holds
        return handle.go_on(cell, lost)
    return handle.wind_down(cell, lost)


def _stopped_there(cell: Cell, event: life.MachineLost) -> Cell:
    failure = f"it was stopped on machine {event.machine} by {event.by}"
    cell = because(cell, Cause.STOPPED_ON_MACHINE)
    return replace(cell, failure=failure, exit=RunnerExit.STOPPED_ON_MACHINE)


def machine_lost_stopping(cell: Cell, event: life.MachineLost) -> Next:
    """End the nodes without the lost member, for which dora would wait during its stop."""
    if not any(
        cell.nodes[node].machine == event.machine for node in table.with_process(cell.nodes)
    ):
        return cell, ()
    return _without_machine(cell, event)


def _end_nodes(cell: Cell, event: life.Event, *actions: Action) -> Next:
    """End the nodes of this machine without dora; other machines end their own nodes."""
    cell = replace(cell, nodes=_without_others(cell, event.at_us))
    after = handle.time_alone(cell)
    return to(replace(cell, awaits_head=False), State.STOPPING, *actions, Do.END_NODES, after=after)


def _without_others(cell: Cell, at_us: int, machine: str = "") -> table.NodeTable:
    """Mark the nodes of `machine`, or of all others, as stopped."""
    return {
        ident: node._replace(state="stopped", since_us=at_us)
        if node.machine and machine in ("", node.machine) and node.state not in _ENDED
        else node
        for ident, node in cell.nodes.items()
    }


def head_stops(cell: Cell, event: life.HeadStops) -> Next:
    """Wait for the nodes to end, which dora stops at the request of the head."""
    cell = replace(cell, stop_by=event.by)
    if event.limit:
        return _await_head(cell, event.limit, _stopping(event.by))
    if not table.has_process(cell.nodes):
        return handle.wind_down(cell, _stopping(event.by))
    return to(cell, State.STOPPING, _stopping(event.by), after=stop_timeout(cell.grace))


def _await_head(cell: Cell, limit: int, *actions: Action) -> Next:
    """Keep the daemon until no machine has a node: the last messages of nodes here may be on it."""
    cell = replace(cell, awaits_head=True, stop_limit=limit)
    return to(cell, State.STOPPING, *actions, after=limit + 2 * ANSWER_MARGIN)


def head_stops_again(cell: Cell, event: life.HeadStops) -> Next:
    """Stop the nodes in the order of the head, or leave, because no machine has a node."""
    if event.limit:
        return _await_head(cell, event.limit)
    if not cell.awaits_head:
        return cell, ()
    cell, actions = handle.go_on(replace(cell, awaits_head=False))
    # The head does not wait any more, or its event of the last exit was faster.
    return cell, actions or (Deadline(LEAVE_TIMEOUT),)


def head_lost(cell: Cell, event: life.HeadLost) -> Next:
    """End the nodes of a member without a head, and exit with success: the head decides more."""
    cell = replace(cell, stop_by=HEAD)
    return _end_nodes(cell, event, _lost(HEAD, event.reason), _stopping(HEAD))


def head_lost_stopping(cell: Cell, event: life.HeadLost) -> Next:
    """End the nodes without dora, because the head is lost while dora stops all nodes."""
    return _end_nodes(cell, event)


def end_early(cell: Cell, event: life.HeadLost | life.HeadStops) -> Next:
    """End a member whose head stops or is lost before any of its nodes runs."""
    by = event.by if isinstance(event, life.HeadStops) else HEAD
    return handle.stop_early(cell, life.StopAsked(event.at_us, by))


def _stopping(by: str) -> Record:
    return Record("dataflow-stopping", "", {"by": by})
