"""The runner's life as one total table: step(cell, event) -> (cell, actions). No I/O, no clock.

    booting -> joining -> starting -> waiting -> running -> closing -> leaving -> ended
                                         \\----------\\-> stopping ---/

Every pair of state and event has an entry in TABLE; tests/unit/test_lifecycle.py takes them all.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from dora_systemd import lifeevents as life
from dora_systemd import nodetable as table
from dora_systemd.causes import Cause
from dora_systemd.cellstate import Action, Cell, Deadline, Do, Record, RunnerExit, State
from dora_systemd.oom import Owner
from dora_systemd.values import SECOND, format_duration
from dora_systemd.wiring import with_downstream

Step = tuple[Cell, tuple[Action, ...]]
Handler = Callable[[Cell, life.Event], Step]

ENGINE_TIMEOUT = 30 * SECOND
"""What dora itself allows its parts to answer each other."""
LEAVE_TIMEOUT = 2 * SECOND
_NOT_READY = ("starting", "restarting")
CASCADE_TIMEOUT = 5 * SECOND
"""Dora ends a dataflow within milliseconds when a node failed before it was ready."""


def stop_timeout(grace: int) -> int:
    """µs until a Stop without an answer is given up: dora kills after 1.5 times the grace."""
    return grace + grace // 2 + 2 * SECOND


def step(cell: Cell, event: life.Event) -> Step:
    """The cell after `event`, and what the runner has to do about it, in this order."""
    return TABLE[cell.state][type(event)](cell, event)


def _ignore(cell: Cell, event: life.Event) -> Step:
    return cell, ()


def _to(cell: Cell, state: State, *actions: Action, after: int | None = None) -> Step:
    return replace(cell, state=state), (*actions, Deadline(after))


def _listening(cell: Cell, event: life.Event) -> Step:
    return _to(cell, State.JOINING, Do.START_DAEMON, after=ENGINE_TIMEOUT)


def _joined(cell: Cell, event: life.Event) -> Step:
    return _to(cell, State.STARTING, Do.SEND_START, after=ENGINE_TIMEOUT)


def _started(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.RunStarted)
    return replace(cell, run=event.run), (Do.SUBSCRIBE,)


def _subscribed(cell: Cell, event: life.Event) -> Step:
    # The launchers wait for OPEN_PIPES, so no node can end before its events are heard; the kinds
    # that dora starts itself can, hence ASK_RESULT.
    return _to(cell, State.WAITING, Do.OPEN_PIPES, Do.ASK_SPAWN, Do.ASK_RESULT)


def _barrier_opened(cell: Cell, event: life.Event) -> Step:
    # It also opens when a node has failed before it was ready. Then dora ends the others, and the
    # start has failed, unless nothing comes of it.
    if any(node.state == "failed" for node in cell.nodes.values()):
        return cell, (Deadline(CASCADE_TIMEOUT),)
    return _run(cell, event)


def _run(cell: Cell, event: life.Event) -> Step:
    cell = replace(cell, nodes=table.all_ready(cell.nodes, event.at_us), ready_us=event.at_us)
    return _to(cell, State.RUNNING, Record("dataflow-started"))


def _start_timed_out(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.StartTimedOut)
    late = [ident for ident, node in cell.nodes.items() if node.state in _NOT_READY]
    reason = f"{_nodes(late)} not ready within {format_duration(event.after)}"
    cell = _because(cell, Cause.START_TIMEOUT, late)
    return _fail(cell, reason, RunnerExit.FAILED)


def _nodes(idents: list[str]) -> str:
    return f"node {idents[0]} was" if len(idents) == 1 else f"nodes {', '.join(idents)} were"


def _refused(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.Refused)
    return _fail(_because(cell, Cause.REFUSED), event.reason, RunnerExit.FAILED)


def _because(cell: Cell, cause: Cause, nodes: Iterable[str] = ()) -> Cell:
    return replace(cell, cause=cause, culprits=tuple(nodes))


def _fail(cell: Cell, reason: str, code: RunnerExit) -> Step:
    cell = replace(cell, failure=reason, exit=code)
    details = {"reason": reason, "cause": str(cell.cause), "nodes": " ".join(cell.culprits)}
    known = {key: text for key, text in details.items() if text}
    return _to(cell, State.ENDED, Record("dataflow-failed", "", known), Do.EXIT)


def _child_exited(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.ChildExited)
    reason = f"the dora {event.child} is gone ({event.exit})"
    cell, actions = _lose(cell, event.child, reason, event.exit)
    return cell, (*_oom_of_all(event), *actions)


def _connection_lost(cell: Cell, event: life.Event) -> Step:
    return _lose(cell, "coordinator", "the dora coordinator closed the control connection", "")


def _lose(cell: Cell, child: str, reason: str, how: str) -> Step:
    cell = _because(cell, Cause(f"{child}-lost"))
    cell, actions = _fail(cell, reason, RunnerExit.ENGINE_LOST)
    return cell, (Record(f"{child}-lost", "", {"exit": how} if how else {}), *actions)


def _engine_deadline(cell: Cell, event: life.Event) -> Step:
    reason = f"dora did not answer within {ENGINE_TIMEOUT // SECOND} s while {cell.state.value}"
    return _fail(_because(cell, Cause.NO_ANSWER), reason, RunnerExit.ENGINE_LOST)


def _node_event(cell: Cell, event: life.Event) -> Step:
    nodes, record = table.update(cell.nodes, event, is_stopping=bool(cell.stop_by))
    actions = () if record is None else (Record(*with_downstream(record, cell.downstream)),)
    return replace(cell, nodes=nodes), (*_oom_of_all(event), *actions)


def _oom_of_all(event: life.Event) -> tuple[Action, ...]:
    """What there is to say about the dataflow when its own limit has killed something of it."""
    if not isinstance(event, life.NodeExited | life.ChildExited) or event.oom is None:
        return ()
    if event.oom.owner is not Owner.DATAFLOW:
        return ()
    return (Record("dataflow-oom", "", event.oom.dataflow_details()),)


def _stop_early(cell: Cell, event: life.Event) -> Step:
    """No node is there yet, or none that dora could be asked to stop."""
    assert isinstance(event, life.StopAsked)
    cell = replace(cell, stop_by=event.by)
    return _to(cell, State.ENDED, _stopping(event), Record("dataflow-stopped"), Do.EXIT)


def _stop(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.StopAsked)
    cell = replace(cell, stop_by=event.by)
    if not table.has_process(cell.nodes):
        return _leave(cell, _stopping(event))
    after = stop_timeout(cell.grace)
    return _to(cell, State.STOPPING, _stopping(event), Do.ASK_STOP, after=after)


def _stopping(event: life.StopAsked) -> Record:
    return Record("dataflow-stopping", "", {"by": event.by})


def _node_event_stopping(cell: Cell, event: life.Event) -> Step:
    cell, actions = _node_event(cell, event)
    if table.has_process(cell.nodes):
        return cell, actions
    # Dora's Stop does not return while a node waits out a restart delay; nothing runs any more.
    return _leave(cell, *actions)


def _leave(cell: Cell, *actions: Action) -> Step:
    return _to(cell, State.LEAVING, *actions, Do.DISMISS_DAEMON, after=LEAVE_TIMEOUT)


def _leave_now(cell: Cell, event: life.Event) -> Step:
    return _leave(cell)


def _run_finished(cell: Cell, event: life.Event) -> Step:
    return _to(cell, State.CLOSING, Do.ASK_RESULT, after=ENGINE_TIMEOUT)


def _result(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.ResultKnown)
    cell = replace(cell, nodes=table.apply_results(cell.nodes, event.results, event.at_us))
    if not event.results:
        lost = _because(cell, Cause.NO_ANSWER)
        return _fail(lost, "dora lost the dataflow", RunnerExit.ENGINE_LOST)
    failed = {node: _known_exit(cell, node, how) for node, how in event.results.items() if how}
    spent = table.spent(cell.nodes)
    if failed or spent:
        reason = ", ".join(f"node {node}: {how}" for node, how in {**failed, **spent}.items())
        code = RunnerExit.NODES_FAILED if spent else RunnerExit.FAILED
        cell = _because(cell, Cause.NODE_FAILED, {**failed, **spent})
        cell = replace(cell, failure=reason, exit=code)
    return _leave(cell)


def _known_exit(cell: Cell, node: str, how: str) -> str:
    return cell.nodes[node].exit if node in cell.nodes else how


def _stop_while_closing(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.StopAsked)
    return replace(cell, stop_by=event.by), ()


def _end(cell: Cell, event: life.Event) -> Step:
    if cell.stop_by:
        # Who asked for the end gets a clean one, whatever a node did on its way out.
        cell = replace(cell, failure="", exit=RunnerExit.OK)
        return _to(cell, State.ENDED, Record("dataflow-stopped"), Do.EXIT)
    if cell.failure:
        return _fail(cell, cell.failure, cell.exit)
    return _to(cell, State.ENDED, Record("dataflow-finished"), Do.EXIT)


def _daemon_left(cell: Cell, event: life.Event) -> Step:
    assert isinstance(event, life.ChildExited)
    return _end(cell, event) if event.child == "daemon" else (cell, ())


def _row(**handlers: Handler) -> dict[type[life.Event], Handler]:
    """One line of the table: what is not named does nothing in that state."""
    assert handlers.keys() <= {event.__name__ for event in life.EVENTS}
    return {event: handlers.get(event.__name__, _ignore) for event in life.EVENTS}


_NODES: dict[str, Handler] = dict.fromkeys(
    ("NodeSpawned", "NodeReady", "NodeExited", "NodeCascaded", "NodeHung"), _node_event
)
_NODES_STOPPING: dict[str, Handler] = dict.fromkeys(_NODES, _node_event_stopping)
_LOST: dict[str, Handler] = {
    "ChildExited": _child_exited,
    "ConnectionLost": _connection_lost,
    "Refused": _refused,
}
_EARLY: dict[str, Handler] = {
    **_LOST,
    "StartTimedOut": _start_timed_out,
    "StopAsked": _stop_early,
    "DeadlinePassed": _engine_deadline,
}
_ALIVE: dict[str, Handler] = {
    **_LOST,
    **_NODES,
    "RunFinished": _run_finished,
    "ResultKnown": _result,
    "StopAsked": _stop,
}
_STOPPING: dict[str, Handler] = {
    **_NODES_STOPPING,
    **dict.fromkeys(
        (
            "StopAnswered",
            "RunFinished",
            "DeadlinePassed",
            "StopAsked",
            "ChildExited",
            "ConnectionLost",
        ),
        _leave_now,
    ),
}

TABLE: Mapping[State, Mapping[type[life.Event], Handler]] = {
    State.BOOTING: _row(**_EARLY, CoordinatorListening=_listening),
    State.JOINING: _row(**_EARLY, DaemonConnected=_joined),
    State.STARTING: _row(**_EARLY, RunStarted=_started, Subscribed=_subscribed),
    State.WAITING: _row(
        **_ALIVE,
        AllReady=_barrier_opened,
        DeadlinePassed=_run,
        StartTimedOut=_start_timed_out,
    ),
    State.RUNNING: _row(**_ALIVE),
    State.STOPPING: _row(**_STOPPING),
    State.CLOSING: _row(
        **{**_LOST, **_NODES},
        ResultKnown=_result,
        StopAsked=_stop_while_closing,
        DeadlinePassed=_engine_deadline,
    ),
    State.LEAVING: _row(**_NODES, ChildExited=_daemon_left, DeadlinePassed=_end, StopAsked=_end),
    State.ENDED: _row(),
}
