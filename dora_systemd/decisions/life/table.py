"""The runner's life as one total table: step(cell, event) -> (cell, actions). No I/O, no clock.

    booting -> joining -> starting -> waiting -> running -> closing -> leaving -> ended
                     \\-----/ gathering     \\----------\\-> stopping ---/

Every pair of state and event has an entry in TABLE; its unit test takes them all.
"""

from collections.abc import Mapping

from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life import failures, machines, stop_order
from dora_systemd.decisions.life import handlers as handle
from dora_systemd.decisions.life.failures import Handler, Next
from dora_systemd.decisions.life.states import Cell, State


def step(cell: Cell, event: life.Event) -> Next:
    """The cell after `event`, and the actions of the runner, in this order."""
    return TABLE[cell.state][type(event)](cell, event)


def _row(**handlers: Handler) -> dict[type[life.Event], Handler]:
    """Build one line of the table: events that are not named have no effect in that state."""
    assert handlers.keys() <= {event.__name__ for event in life.EVENTS}
    return {event: handlers.get(event.__name__, handle.ignore) for event in life.EVENTS}


_NODES: dict[str, Handler] = dict.fromkeys(
    ("NodeSpawned", "NodeReady", "NodeExited", "NodeCascaded", "NodeHung"), handle.node_event
)
_RELOADS: dict[str, Handler] = {
    **dict.fromkeys(
        ("NodeAsked", "NodeKept", "NodeReloading", "NodeAdded", "NodeRemoved", "NodeLacks"),
        handle.node_event,
    ),
    "NodeMet": handle.node_met,
    "ReloadNoted": handle.note_reload,
    "ReloadAsked": handle.reload,
}
_LOST: dict[str, Handler] = {
    "ChildExited": failures.child_exited,
    "ConnectionLost": failures.connection_lost,
    "Refused": failures.refused,
    "Failed": failures.broken,
}
_PART: dict[str, Handler] = {
    "MachineLost": machines.machine_lost,
    "HeadStops": machines.head_stops,
    "HeadLost": machines.head_lost,
}
_EARLY: dict[str, Handler] = {
    **_LOST,
    **dict.fromkeys(("HeadStops", "HeadLost"), machines.end_early),
    "MachineJoined": machines.machine_joined,
    "MachineLost": machines.machine_away,
    "MachinesAwaited": machines.awaited,
    "StartTimedOut": handle.start_timed_out,
    "StopAsked": handle.stop_early,
    "DeadlinePassed": failures.engine_deadline,
    "ReloadNoted": handle.note_reload,
}
_ALIVE: dict[str, Handler] = {
    **_LOST,
    **_NODES,
    **_PART,
    "RunFinished": handle.run_finished,
    "ResultKnown": handle.result,
    "StopAsked": handle.stop,
}
_RUNNING: dict[str, Handler] = {
    **_ALIVE,
    **_RELOADS,
    "NodeExited": handle.node_exited,
    "NodeReloading": handle.node_reloading,
    "NodeAdded": handle.node_reloading,
    "ReloadNoted": handle.reload_noted,
}
_STOPPING: dict[str, Handler] = {
    **dict.fromkeys(_NODES, handle.node_event_stopping),
    **dict.fromkeys(("StopAnswered", "RunFinished", "DeadlinePassed"), handle.leave_now),
    **dict.fromkeys(("ChildExited", "ConnectionLost"), handle.leave_now),
    "Failed": failures.broken,
    "StopAsked": handle.stop_again,
    "NodeOverdue": stop_order.overdue,
    "NodeExtends": stop_order.extend,
    "NodeTurn": stop_order.take_turn,
    "HeadStops": machines.head_stops_again,
    "MachineLost": machines.machine_lost_stopping,
    "HeadLost": machines.head_lost_stopping,
}

TABLE: Mapping[State, Mapping[type[life.Event], Handler]] = {
    State.BOOTING: _row(
        **{**_EARLY, "DeadlinePassed": machines.boot_deadline},
        CoordinatorListening=handle.listening,
    ),
    State.JOINING: _row(**_EARLY, DaemonConnected=machines.joined),
    State.GATHERING: _row(
        **_EARLY,
        Gathered=machines.gathered,
        RunStarted=machines.found,
        ReloadAsked=machines.take_other_ports,
    ),
    State.STARTING: _row(
        **{**_EARLY, **_PART}, RunStarted=handle.started, Subscribed=handle.subscribed
    ),
    State.WAITING: _row(
        **{**_ALIVE, **_RELOADS, "NodeExited": handle.node_event_waiting},
        AllReady=handle.barrier_opened,
        DeadlinePassed=handle.run,
        StartTimedOut=handle.start_timed_out,
    ),
    State.RUNNING: _row(
        **_RUNNING,
        NodeSilent=handle.silent,
        NodeSpeaks=handle.node_event,
    ),
    State.STOPPING: _row(**_STOPPING),
    State.CLOSING: _row(
        **{**_LOST, **_NODES},
        ResultKnown=handle.result,
        StopAsked=handle.stop_while_closing,
        DeadlinePassed=failures.engine_deadline,
    ),
    State.LEAVING: _row(
        **_NODES,
        ChildExited=handle.daemon_left,
        DeadlinePassed=handle.end,
        Failed=handle.raised_leaving,
        StopAsked=handle.stop_leaving,
    ),
    State.ENDED: _row(),
}
