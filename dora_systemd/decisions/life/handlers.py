"""The handlers of the runner's state machine: the entries of TABLE in table.py.

A handler takes the cell and an event and returns the new cell and the actions to perform, in this
order. It is pure: no I/O and no clock, because the time is in the event. `pump.py` performs the
actions, and each answer of dora is another event.

to() changes the state and always adds a Deadline, which replaces the one before: each state has
its own timeout. A handler that returns `cell, ()` leaves the current deadline running. So
started() need not set one: the 30 s of STARTING cover the run id and the subscription.
A handler must accept every cell of the states that TABLE lists it for. It must not assume which
events came before: dora's events and the ends of its processes arrive in any order.
"""

from dataclasses import replace

from dora_systemd.decisions.cell.exits import parse_exit
from dora_systemd.decisions.cell.owes import FAIL
from dora_systemd.decisions.cell.status import HELD, LATCHED, NodeStatus, is_stopped
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life import node_table as table
from dora_systemd.decisions.life import stop_order
from dora_systemd.decisions.life.causes import ESSENTIAL, Cause
from dora_systemd.decisions.life.failures import (
    ENGINE_TIMEOUT,
    Next,
    because,
    blamed_early,
    blamed_early_results,
    broken,
    fail,
    is_doomed,
    noted_early,
    oom_of_all,
    to,
    with_early_cause,
)
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import (
    Action,
    Cell,
    Deadline,
    Do,
    Record,
    State,
    StopStep,
)
from dora_systemd.decisions.life.stop_budget import ANSWER_MARGIN, LEAVE_TIMEOUT, stop_timeout
from dora_systemd.values import SECOND, format_duration

_NOT_READY = ("starting", "restarting")
CASCADE_TIMEOUT = 5 * SECOND
"""µs; dora ends a dataflow within milliseconds after a node failed before it was ready."""


def ignore(cell: Cell, event: life.Event) -> Next:
    """Leave the cell as it is, because the event has no effect in this state."""
    return cell, ()


def listening(cell: Cell, event: life.Event) -> Next:
    """Start the daemon, because the coordinator listens."""
    return to(cell, State.JOINING, Do.START_DAEMON, after=ENGINE_TIMEOUT)


def joined(cell: Cell, event: life.Event) -> Next:
    """Send the descriptor, because the daemon has registered."""
    return to(cell, State.STARTING, Do.SEND_START, after=ENGINE_TIMEOUT)


def started(cell: Cell, event: life.RunStarted) -> Next:
    """Subscribe to the events of the run, after dora has accepted the descriptor."""
    return replace(cell, run=event.run), (Do.SUBSCRIBE,)


def subscribed(cell: Cell, event: life.Event) -> Next:
    """Open the pipes, because with the active subscription no event of a node gets lost."""
    # Launchers wait for OPEN_PIPES, so their nodes cannot end before this. Nodes that dora starts
    # without a launcher can, and no event would report that: ASK_RESULT queries whether the run has
    # ended.
    return to(cell, State.WAITING, Do.OPEN_PIPES, Do.ASK_SPAWN, Do.ASK_RESULT)


def barrier_opened(cell: Cell, event: life.Event) -> Next:
    """Let the dataflow run after dora has opened its start barrier, unless a node failed before."""
    # Dora also opens the barrier after a node ended before it was ready, and then fails the other
    # nodes: RunFinished follows. If it does not follow within CASCADE_TIMEOUT, the dataflow runs.
    if any(node.state == "failed" for node in cell.nodes.values()) or is_doomed(cell):
        return cell, (Deadline(CASCADE_TIMEOUT),)
    return run(cell, event)


def run(cell: Cell, event: life.Event) -> Next:
    """Mark all nodes as ready and the dataflow as running."""
    cell = replace(cell, nodes=table.all_ready(cell.nodes, event.at_us), ready_us=event.at_us)
    return to(cell, State.RUNNING, Record("dataflow-started"))


def start_timed_out(cell: Cell, event: life.StartTimedOut) -> Next:
    """Fail the start, and name the nodes that are not ready.

    The time in which a node waits for what it needs does not count: the runner starts a new timeout
    when the wait ends.
    """
    if table.lacking(cell.nodes) or event.at_us < cell.met_us:
        return cell, ()
    late = [ident for ident, node in cell.nodes.items() if node.state in _NOT_READY]
    reason = f"{_nodes(late)} not ready within {format_duration(event.after)}"
    return _fail_start(because(cell, Cause.START_TIMEOUT, late), reason)


def _fail_start(cell: Cell, reason: str) -> Next:
    if not cell.is_trial:
        return fail(cell, reason, RunnerExit.FAILED)
    # A reload started this run, and the version before it follows: stop the nodes properly.
    cell = replace(cell, failure=reason, exit=RunnerExit.FAILED)
    return to(cell, State.STOPPING, Do.ASK_STOP, after=stop_timeout(cell.grace))


def _nodes(idents: list[str]) -> str:
    return f"node {idents[0]} was" if len(idents) == 1 else f"nodes {', '.join(idents)} were"


def node_event(cell: Cell, event: life.Event) -> Next:
    """Update the live table for an event of a node, and record what it means."""
    is_open = cell.ready_us > 0
    stops = _is_stopping(cell)
    nodes, records = table.update(cell.nodes, event, is_stopping=stops, is_open=is_open)
    actions = (table.with_downstream(one, cell.downstream) for one in records)
    return replace(cell, nodes=nodes), (*oom_of_all(event), *actions)


def node_met(cell: Cell, event: life.NodeMet) -> Next:
    """End the wait of a node for its needs, and give it the whole start timeout again."""
    return node_event(replace(cell, met_us=event.at_us), event)


def _is_stopping(cell: Cell) -> bool:
    return bool(cell.stop_by or cell.failure) or cell.reload


def stop_early(cell: Cell, event: life.StopAsked) -> Next:
    """Stop before the launchers have started nodes: end at once; EXIT kills all processes."""
    cell = replace(cell, stop_by=event.by)
    return to(cell, State.ENDED, _stopping(event), Record("dataflow-stopped"), Do.EXIT)


def stop(cell: Cell, event: life.StopAsked) -> Next:
    """Have dora stop the nodes, if any of them runs."""
    stopped = replace(cell, stop_by=event.by, stop_us=event.at_us)
    return wind_down(stopped, _stopping(event))


def _stopping(event: life.StopAsked) -> Record:
    return Record("dataflow-stopping", "", {"by": event.by})


def node_event_stopping(cell: Cell, event: life.Event) -> Next:
    """Record a node event while stopping; dismiss the daemon after the last node has exited."""
    cell, actions = node_event(cell, event)
    return go_on(cell, *actions)


def go_on(cell: Cell, *actions: Action) -> Next:
    """Stop the next nodes, if the stop has an order; dismiss the daemon if none is left."""
    if table.has_process(cell.nodes) or cell.awaits_head:
        cell, stops = stop_order.advance(cell)
        return cell, (*actions, *stops)
    # Do not wait for the answer to Stop: dora sends none while a node is in its restart delay.
    return _leave(cell, *actions)


def _leave(cell: Cell, *actions: Action) -> Next:
    return to(cell, State.LEAVING, *actions, Do.DISMISS_DAEMON, after=LEAVE_TIMEOUT)


def leave_now(cell: Cell, event: life.Event) -> Next:
    """Dismiss the daemon: there is nothing else to wait for."""
    return _leave(cell)


def reload(cell: Cell, event: life.Event) -> Next:
    """Wind down as for a stop, but record no event: the reloader starts the next run."""
    return wind_down(replace(cell, reload=True))


def wind_down(cell: Cell, *actions: Action) -> Next:
    """Have dora stop the nodes that have processes, or dismiss the daemon if there are none."""
    if not table.has_process(cell.nodes):
        return _leave(cell, *actions)
    if stop_order.has_order(cell):
        cell, stops = stop_order.advance(cell)
        after = cell.stop_limit + ANSWER_MARGIN
        return to(cell, State.STOPPING, *actions, *stops, after=after)
    return to(cell, State.STOPPING, *actions, Do.ASK_STOP, after=time_alone(cell))


def time_alone(cell: Cell) -> int:
    """µs for the end of the nodes without an order. On a member each may have a time of its own."""
    if cell.machine and cell.stops and cell.ready_us:
        return cell.stop_limit + ANSWER_MARGIN
    return stop_timeout(cell.grace)


def stop_again(cell: Cell, event: life.StopAsked) -> Next:
    """Handle a stop while stopping: skip the grace period, or turn a reload into a stop.

    stop_by is empty while a reload or a failed trial stops the nodes.
    """
    if cell.awaits_head and not cell.stop_us:  # the machine of this member shuts down meanwhile
        return replace(cell, stop_us=event.at_us), ()
    if cell.stop_by:
        return _leave(cell)
    return replace(cell, stop_by=event.by, reload=False), (_stopping(event),)


def stop_leaving(cell: Cell, event: life.StopAsked) -> Next:
    """Stop while the daemon leaves: end at once, and record the end as a stop."""
    return end(replace(cell, stop_by=event.by, reload=False), event)


def note_reload(cell: Cell, event: life.ReloadNoted) -> Next:
    """Set the notice of the last reload, which the status line shows."""
    cell = replace(cell, notice=event.notice)
    return cell if event.downstream is None else replace(cell, downstream=event.downstream), ()


def node_event_waiting(cell: Cell, event: life.NodeExited) -> Next:
    """Handle the exit of a node before the start barrier: fail the start, or keep a held node.

    A node with the policy HELD waits for a reload after it failed. That is no help while the start
    can still fail: on the first run, and in a trial, where the version before can come back.
    """
    event = with_early_cause(cell, event)
    blamed, records = blamed_early(cell, event)
    after, actions = node_event(blamed, event)
    after, actions = noted_early(cell, after, event.node), (*records, *actions)
    node = after.nodes[event.node]
    if node.state == "failed" and node.policy == LATCHED:
        return _fail_early(after, event.node, actions)
    is_final = cell.is_trial or not cell.is_again
    if is_final and node.state == "failed" and node.policy == HELD:
        return _fail_early(after, event.node, actions)
    return after, actions


def _fail_early(cell: Cell, node: str, actions: tuple[Action, ...]) -> Next:
    reason = f"node {node}: {cell.nodes[node].exit} before it was ready"
    failed, more = _fail_start(because(cell, Cause.NODE_FAILED, [node]), reason)
    return failed, (*actions, *more)


def run_finished(cell: Cell, event: life.Event) -> Next:
    """Request the result from dora, because all nodes have exited."""
    return to(cell, State.CLOSING, Do.ASK_RESULT, after=ENGINE_TIMEOUT)


def result(cell: Cell, event: life.ResultKnown) -> Next:
    """Decide by the results of the nodes between a finished and a failed dataflow."""
    event = replace(event, results=blamed_early_results(event.results))
    cell = replace(cell, nodes=table.apply_results(cell.nodes, event.results, event.at_us))
    if not event.results:
        lost = because(cell, Cause.NO_ANSWER)
        return fail(lost, "dora lost the dataflow", RunnerExit.ENGINE_LOST)
    failed = {
        node: str(cell.nodes[node].exit if node in cell.nodes else how)
        for node, how in event.results.items()
        if how.is_failure and not is_stopped(cell.nodes.get(node, NodeStatus()))
    }
    spent = table.spent(cell.nodes)
    if failed or spent:
        # First those that have failed by themselves; dora reports the nodes in any order.
        ends = dict(
            sorted({**failed, **spent}.items(), key=lambda one: bool(parse_exit(one[1]).by))
        )
        reason = ", ".join(f"node {node}: {how}" for node, how in ends.items())
        code = RunnerExit.NODES_FAILED if spent else RunnerExit.FAILED
        cell = because(cell, Cause.NODE_FAILED, ends)
        cell = replace(cell, failure=reason, exit=code)
    elif not (cell.ready_us or _is_stopping(cell)):
        # All nodes have ended before dora's start barrier was reported, but it was open.
        return _leave(replace(cell, ready_us=event.at_us), Record("dataflow-started"))
    return _leave(cell)


def stop_while_closing(cell: Cell, event: life.StopAsked) -> Next:
    """Record a stop request while the result is pending; the run itself has ended."""
    return replace(cell, stop_by=event.by), ()


def end(cell: Cell, event: life.Event) -> Next:
    """Record the end and exit, because nothing runs any more."""
    if cell.stop_by:
        cell = replace(cell, failure="", exit=_exit_of_stop(cell))
        return to(cell, State.ENDED, Record("dataflow-stopped"), Do.EXIT)
    if cell.reload:
        return to(replace(cell, failure="", exit=RunnerExit.OK), State.ENDED, Do.EXIT)
    if cell.failure:
        return fail(cell, cell.failure, cell.exit)
    return to(cell, State.ENDED, Record("dataflow-finished"), Do.EXIT)


def raised_leaving(cell: Cell, event: life.Failed) -> Next:
    """Keep the known result after an exception, but fail if another run should follow."""
    return broken(cell, event) if cell.reload else end(cell, event)


def _exit_of_stop(cell: Cell) -> RunnerExit:
    """Return the exit status of a requested stop, which counts as clean for a service.

    `doractl run` ends as `dora run` does, which fails if a node failed on the way out, but not if
    dora's SIGTERM after the grace has ended it. For its unit that status is a success: the stop
    itself has worked.
    """
    ended = cell.stop_us + cell.grace
    failed = (
        _has_failed_at_stop(node, ended)
        for ident, node in cell.nodes.items()
        if cell.ending.get(ident) is not StopStep.TERMINATED
    )
    return RunnerExit.FAILED_AT_STOP if cell.is_attached and any(failed) else RunnerExit.OK


def _has_failed_at_stop(node: NodeStatus, grace_ends_us: int) -> bool:
    if is_stopped(node):  # by an earlier request for this node
        return False
    is_late = node.state == "stopped" and node.since_us >= grace_ends_us
    return node.exit.is_failure and not (is_late and node.exit.is_terminated)


def daemon_left(cell: Cell, event: life.ChildExited) -> Next:
    """End the cell when the daemon has exited."""
    return end(cell, event) if event.child == "daemon" else (cell, ())


def node_exited(cell: Cell, event: life.NodeExited) -> Next:
    """Record the exit of a node; end the dataflow if an essential node will not restart."""
    after, actions = node_event(cell, event)
    before = cell.nodes.get(event.node)
    if before is None or not event.is_essential or is_replaced(cell, before):
        return after, actions
    return _without(after, event.node, actions) if is_lost(after, event.node) else (after, actions)


def reload_noted(cell: Cell, event: life.ReloadNoted) -> Next:
    """Record the end of a reload; end the dataflow if the reload left an essential node failed."""
    after, actions = note_reload(cell, event)
    lost = [node for node in event.essential if is_lost(after, node)]
    return _without(after, lost[0], actions) if lost else (after, actions)


def node_reloading(cell: Cell, event: life.Event) -> Next:
    """Record that a reload replaces or adds a node; the notice of the last reload ends."""
    return node_event(replace(cell, notice=""), event)


def is_replaced(cell: Cell, node: NodeStatus) -> bool:
    """Whether this is the first process after a reload, whose failure the reloader undoes.

    While the dataflow runs, only such a process has never been ready and is no restart of dora's.
    With a notice the reload is over, because the process was too slow. A requested restart of a
    node has no earlier version to return to.
    """
    return node.state == "starting" and not (node.restarts or cell.notice or node.asked)


def is_lost(cell: Cell, ident: str) -> bool:
    """Whether a node has failed and will not start again.

    With the policy HELD a failed node waits for a reload. With LATCHED the end is not final yet: a
    device that the node needs may be gone, and if not, its launcher exits in its place.
    """
    node = cell.nodes.get(ident)
    return node is not None and node.state == "failed" and node.policy not in (HELD, LATCHED)


def _without(cell: Cell, node: str, actions: tuple[Action, ...]) -> Next:
    """End the dataflow because of this essential node.

    A node without restarts left must not get more by a restart of the unit: the exit status
    prevents that.
    """
    spent = table.spent(cell.nodes)
    reason = f"{ESSENTIAL}node {node}: {spent.get(node) or cell.nodes[node].exit}"
    code = RunnerExit.NODES_FAILED if node in spent else RunnerExit.FAILED
    cell = because(cell, Cause.NODE_FAILED, [node])
    return wind_down(replace(cell, failure=reason, exit=code), *actions)


def silent(cell: Cell, event: life.NodeSilent) -> Next:
    """Record that a node owes an output, and end the dataflow if the setting requires it."""
    cell, actions = node_event(cell, event)
    if event.then != FAIL:
        return cell, actions
    reason = f"node {event.node}: {event.reason}"
    cell = replace(because(cell, Cause.NODE_SILENT, [event.node]), failure=reason)
    cell = replace(cell, exit=RunnerExit.FAILED)
    return wind_down(cell, *actions)
