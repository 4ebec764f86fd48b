"""What the runner's state machine does about an event: the entries of TABLE in table.py."""

from dataclasses import replace

from dora_systemd.decisions.cell.status import HELD
from dora_systemd.decisions.descriptor.wiring import with_downstream
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life import nodes as table
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.failures import ENGINE_TIMEOUT, Step, because, fail, oom_of_all, to
from dora_systemd.decisions.life.states import Action, Cell, Deadline, Do, Record, RunnerExit, State
from dora_systemd.decisions.life.stop_budget import LEAVE_TIMEOUT, stop_timeout
from dora_systemd.values import SECOND, format_duration

_NOT_READY = ("starting", "restarting")
CASCADE_TIMEOUT = 5 * SECOND
"""Dora ends a dataflow within milliseconds when a node failed before it was ready."""


def ignore(cell: Cell, event: life.Event) -> Step:
    """Nothing that matters in this state."""
    return cell, ()


def listening(cell: Cell, event: life.Event) -> Step:
    """The coordinator is there: the daemon comes next."""
    return to(cell, State.JOINING, Do.START_DAEMON, after=ENGINE_TIMEOUT)


def joined(cell: Cell, event: life.Event) -> Step:
    """Both are there: dora is sent the descriptor."""
    return to(cell, State.STARTING, Do.SEND_START, after=ENGINE_TIMEOUT)


def started(cell: Cell, event: life.Event) -> Step:
    """Dora has accepted it."""
    assert isinstance(event, life.RunStarted)
    return replace(cell, run=event.run), (Do.SUBSCRIBE,)


def subscribed(cell: Cell, event: life.Event) -> Step:
    """From here on nothing that happens to a node is missed."""
    # The launchers wait for OPEN_PIPES, so no node can end before its events are heard; the kinds
    # that dora starts itself can, hence ASK_RESULT.
    return to(cell, State.WAITING, Do.OPEN_PIPES, Do.ASK_SPAWN, Do.ASK_RESULT)


def barrier_opened(cell: Cell, event: life.Event) -> Step:
    """Messages flow, unless a node has failed before it was ready."""
    # It also opens when a node has failed before it was ready. Then dora ends the others, and the
    # start has failed, unless nothing comes of it.
    if any(node.state == "failed" for node in cell.nodes.values()):
        return cell, (Deadline(CASCADE_TIMEOUT),)
    return run(cell, event)


def run(cell: Cell, event: life.Event) -> Step:
    """The dataflow runs."""
    cell = replace(cell, nodes=table.all_ready(cell.nodes, event.at_us), ready_us=event.at_us)
    return to(cell, State.RUNNING, Record("dataflow-started"))


def start_timed_out(cell: Cell, event: life.Event) -> Step:
    """Nodes that are late end it."""
    assert isinstance(event, life.StartTimedOut)
    late = [ident for ident, node in cell.nodes.items() if node.state in _NOT_READY]
    reason = f"{_nodes(late)} not ready within {format_duration(event.after)}"
    return _fail_start(because(cell, Cause.START_TIMEOUT, late), reason)


def _fail_start(cell: Cell, reason: str) -> Step:
    if not cell.is_trial:
        return fail(cell, reason, RunnerExit.FAILED)
    # Another run follows, so this one ends in good order.
    cell = replace(cell, failure=reason, exit=RunnerExit.FAILED)
    return to(cell, State.STOPPING, Do.ASK_STOP, after=stop_timeout(cell.grace))


def _nodes(idents: list[str]) -> str:
    return f"node {idents[0]} was" if len(idents) == 1 else f"nodes {', '.join(idents)} were"


def node_event(cell: Cell, event: life.Event) -> Step:
    """Something happened to a node."""
    is_open = cell.ready_us > 0
    stops = _is_stopping(cell)
    nodes, record = table.update(cell.nodes, event, is_stopping=stops, is_open=is_open)
    actions = () if record is None else (Record(*with_downstream(record, cell.downstream)),)
    return replace(cell, nodes=nodes), (*oom_of_all(event), *actions)


def _is_stopping(cell: Cell) -> bool:
    return bool(cell.stop_by) or cell.reload or (cell.is_trial and bool(cell.failure))


def stop_early(cell: Cell, event: life.Event) -> Step:
    """No node is there yet, or none that dora could be asked to stop."""
    assert isinstance(event, life.StopAsked)
    cell = replace(cell, stop_by=event.by)
    return to(cell, State.ENDED, _stopping(event), Record("dataflow-stopped"), Do.EXIT)


def stop(cell: Cell, event: life.Event) -> Step:
    """Dora ends the nodes, if there are any."""
    assert isinstance(event, life.StopAsked)
    return _wind_down(replace(cell, stop_by=event.by), _stopping(event))


def _stopping(event: life.StopAsked) -> Record:
    return Record("dataflow-stopping", "", {"by": event.by})


def node_event_stopping(cell: Cell, event: life.Event) -> Step:
    """The last of them was waited for."""
    cell, actions = node_event(cell, event)
    if table.has_process(cell.nodes):
        return cell, actions
    # Dora's Stop does not return while a node waits out a restart delay; nothing runs any more.
    return _leave(cell, *actions)


def _leave(cell: Cell, *actions: Action) -> Step:
    return to(cell, State.LEAVING, *actions, Do.DISMISS_DAEMON, after=LEAVE_TIMEOUT)


def leave_now(cell: Cell, event: life.Event) -> Step:
    """There is nothing left to wait for."""
    return _leave(cell)


def reload(cell: Cell, event: life.Event) -> Step:
    """End as for a stop, and without a word: who asked for it starts the next life."""
    return _wind_down(replace(cell, reload=True))


def _wind_down(cell: Cell, *actions: Action) -> Step:
    if not table.has_process(cell.nodes):
        return _leave(cell, *actions)
    return to(cell, State.STOPPING, *actions, Do.ASK_STOP, after=stop_timeout(cell.grace))


def stop_again(cell: Cell, event: life.Event) -> Step:
    """Asked twice, it does not wait any longer; a reload gives way to a stop."""
    assert isinstance(event, life.StopAsked)
    if cell.stop_by:
        return _leave(cell)
    return replace(cell, stop_by=event.by, reload=False), (_stopping(event),)


def stop_leaving(cell: Cell, event: life.Event) -> Step:
    """A stop is in a hurry, and it is what this end is called."""
    assert isinstance(event, life.StopAsked)
    return end(replace(cell, stop_by=event.by, reload=False), event)


def reshape(cell: Cell, event: life.Event) -> Step:
    """A reload changes which nodes there are."""
    return replace(cell, nodes=table.reshape(cell.nodes, event)), ()


def note_reload(cell: Cell, event: life.Event) -> Step:
    """What a reload has left to say, for the status line."""
    assert isinstance(event, life.ReloadNoted)
    cell = replace(cell, notice=event.notice)
    return cell if event.downstream is None else replace(cell, downstream=event.downstream), ()


def node_event_waiting(cell: Cell, event: life.Event) -> Step:
    """A node that is to wait for a reload does not do so when the start can fail instead."""
    after, actions = node_event(cell, event)
    if isinstance(event, life.NodeExited) and (cell.is_trial or not cell.is_again):
        node = after.nodes[event.node]
        if node.state == "failed" and node.policy == HELD:
            reason = f"node {event.node}: {node.exit} before it was ready"
            after = because(after, Cause.NODE_FAILED, [event.node])
            failed, more = _fail_start(after, reason)
            return failed, (*actions, *more)
    return after, actions


def run_finished(cell: Cell, event: life.Event) -> Step:
    """No node is left: dora knows how they ended."""
    return to(cell, State.CLOSING, Do.ASK_RESULT, after=ENGINE_TIMEOUT)


def result(cell: Cell, event: life.Event) -> Step:
    """How they ended decides how the dataflow did."""
    assert isinstance(event, life.ResultKnown)
    cell = replace(cell, nodes=table.apply_results(cell.nodes, event.results, event.at_us))
    if not event.results:
        lost = because(cell, Cause.NO_ANSWER)
        return fail(lost, "dora lost the dataflow", RunnerExit.ENGINE_LOST)
    failed = {node: _known_exit(cell, node, how) for node, how in event.results.items() if how}
    spent = table.spent(cell.nodes)
    if failed or spent:
        reason = ", ".join(f"node {node}: {how}" for node, how in {**failed, **spent}.items())
        code = RunnerExit.NODES_FAILED if spent else RunnerExit.FAILED
        cell = because(cell, Cause.NODE_FAILED, {**failed, **spent})
        cell = replace(cell, failure=reason, exit=code)
    return _leave(cell)


def _known_exit(cell: Cell, node: str, how: str) -> str:
    return cell.nodes[node].exit if node in cell.nodes else how


def stop_while_closing(cell: Cell, event: life.Event) -> Step:
    """It ends by itself already."""
    assert isinstance(event, life.StopAsked)
    return replace(cell, stop_by=event.by), ()


def end(cell: Cell, event: life.Event) -> Step:
    """Nothing runs any more: this is how it ended."""
    if cell.stop_by:
        # Who asked for the end gets a clean one, whatever a node did on its way out.
        cell = replace(cell, failure="", exit=RunnerExit.OK)
        return to(cell, State.ENDED, Record("dataflow-stopped"), Do.EXIT)
    if cell.reload:
        return to(replace(cell, failure="", exit=RunnerExit.OK), State.ENDED, Do.EXIT)
    if cell.failure:
        return fail(cell, cell.failure, cell.exit)
    return to(cell, State.ENDED, Record("dataflow-finished"), Do.EXIT)


def daemon_left(cell: Cell, event: life.Event) -> Step:
    """The last that there was to wait for."""
    assert isinstance(event, life.ChildExited)
    return end(cell, event) if event.child == "daemon" else (cell, ())
