"""The live table of nodes: how each life event changes it. Pure."""

from collections.abc import Mapping
from dataclasses import replace

from dora_systemd.decisions.cell.exits import EARLY, KILLED, Exit, ExitKind
from dora_systemd.decisions.cell.owes import RESTART
from dora_systemd.decisions.cell.status import (
    HELD,
    LATCHED,
    STOP,
    NodeStatus,
    is_stopped,
    was_asked,
)
from dora_systemd.decisions.descriptor.dataflow import Downstream
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.logs.journal_events import NODE_FAILURES
from dora_systemd.values import SECOND, counted, format_duration

NodeTable = Mapping[str, NodeStatus]
Change = tuple[NodeTable, Record | None]
"""The table after an event, and the life event for the journal."""

WITH_PROCESS = frozenset({"starting", "ready", "running"})
_MAYBE = ("reloading", "waiting", "stopped")


def has_process(nodes: NodeTable) -> bool:
    """Whether dora has a process of any node, according to the events so far."""
    return bool(with_process(nodes))


def with_process(nodes: NodeTable) -> list[str]:
    """The nodes of which dora has a process, according to the events so far."""
    return [
        ident
        for ident, node in nodes.items()
        if node.state in WITH_PROCESS or (node.state in _MAYBE and node.pid)
    ]


def busy_machines(nodes: NodeTable) -> set[str]:
    """The machines on which dora has a process; "" for this one."""
    return {nodes[ident].machine for ident in with_process(nodes)}


def all_ready(nodes: NodeTable, at_us: int) -> NodeTable:
    """Return the table after dora has opened its start barrier."""
    return {
        ident: node._replace(state="running", since_us=at_us) if node.state == "ready" else node
        for ident, node in nodes.items()
    }


def update(
    nodes: NodeTable, event: life.Event, *, is_stopping: bool, is_open: bool
) -> tuple[NodeTable, tuple[Record, ...]]:
    """Return the table after an event, and the records for the journal.

    is_open: whether dora's start barrier is open; then a ready node runs, even if it is alone.
    Each restart that the table counts is recorded, so `list` and `why` have the same number.
    """
    after, record = _changed(nodes, event, is_stopping, is_open)
    own, restarted = [record] if record else [], _restarted(nodes, after)
    # A stale exit was before the restart. All other events of a restart are of the new process.
    is_stale = isinstance(event, life.NodeExited) and event.is_stale
    return after, (*own, *restarted) if is_stale else (*restarted, *own)


def _restarted(before: NodeTable, after: NodeTable) -> list[Record]:
    return [
        Record("node-restarted", ident, {"restarts": str(node.restarts)})
        for ident, node in after.items()
        if ident in before and node.restarts > before[ident].restarts
    ]


def _changed(nodes: NodeTable, event: life.Event, is_stopping: bool, is_open: bool) -> Change:
    record: Record | None = None
    match event:
        case life.NodeSpawned():
            nodes, record = _spawned(nodes, event)
        case life.NodeReady():
            nodes, record = _ready(nodes, event, is_open)
        case life.NodeExited():
            nodes, record = _exited(nodes, event, is_stopping)
        case life.NodeCascaded():
            nodes = _set(nodes, event.node, event.at_us, state="failed", exit=Exit(by=event.by))
        case life.NodeHung():
            nodes, record = _hung(nodes, event)
        case life.NodeSilent() | life.NodeSpeaks():
            nodes, record = _heard(nodes, event)
        case life.NodeLacks() | life.NodeMet():
            nodes, record = _needs(nodes, event)
        case life.NodeAsked() | life.NodeReloading() | life.NodeKept():
            nodes, record = _told_to_end(nodes, event)
        case life.NodeAdded() | life.NodeRemoved():
            others = {ident: node for ident, node in nodes.items() if ident != event.node}
            nodes = {**others, **_added(event)}
    return nodes, record


def _set(nodes: NodeTable, ident: str, at_us: int, **changes: str | int | Exit) -> NodeTable:
    old = nodes.get(ident, NodeStatus())
    if changes.get("state") != old.state:
        changes["since_us"] = at_us
    return {**nodes, ident: old._replace(**changes)}  # type: ignore[arg-type]


def _ready(nodes: NodeTable, event: life.NodeReady, is_open: bool) -> Change:
    old, record = nodes.get(event.node, NodeStatus()), Record("node-ready", event.node)
    if is_stopped(old):  # dora has stopped the node meanwhile
        return nodes, record
    fresh: dict[str, int | str | Exit] = {"restarts": _count(old), "asked": "", "asked_by": ""}
    if old.asked:
        fresh["exit"] = Exit()  # that end was requested
    state = "running" if is_open else "ready"
    return _set(nodes, event.node, event.at_us, state=state, **fresh), record


def _added(event: life.NodeAdded | life.NodeRemoved) -> NodeTable:
    return {event.node: event.status} if isinstance(event, life.NodeAdded) else {}


def _told_to_end(
    nodes: NodeTable, event: life.NodeAsked | life.NodeReloading | life.NodeKept
) -> Change:
    if isinstance(event, life.NodeAsked):
        return _asked(nodes, event)
    if isinstance(event, life.NodeReloading):
        return _reloading(nodes, event), None
    return _kept(nodes, event), None


def _kept(nodes: NodeTable, event: life.NodeKept) -> NodeTable:
    """Forget a request for a process that has not ended: its end is not requested now."""
    old = nodes.get(event.node, NodeStatus())
    is_same = was_asked(old) and old.pid == event.status.pid
    return {**nodes, event.node: event.status} if is_same else nodes


def _reloading(nodes: NodeTable, event: life.NodeReloading) -> NodeTable:
    """Record a reload of a node, whose new process has its own restart counter."""
    old = nodes.get(event.node, NodeStatus())
    status = (event.status or old)._replace(state="reloading", pid=old.pid, since_us=event.at_us)
    if old.needs:  # the new process waits as well
        status = status._replace(state=old.state, needs=old.needs, since_us=old.since_us)
    return {**nodes, event.node: status}


def _asked(nodes: NodeTable, event: life.NodeAsked) -> Change:
    """Record a requested restart or stop of a node, whose process is about to end."""
    if event.node not in nodes:
        return nodes, None
    old = nodes[event.node]
    record = Record("node-asked", event.node, {"asked": event.what, "by": event.by})
    if event.what == STOP:
        # Earlier faults of the node are over, and its end is no failure.
        new = NodeStatus("stopped", old.pid, old.restarts, event.at_us)._replace(
            **{key: getattr(old, key) for key in _KEPT}, is_held=old.state == "waiting"
        )
    elif old.state == "waiting":
        # The node keeps waiting: its next process exists, and dora counts restarts from zero again.
        return {**nodes, event.node: old._replace(restarts=0)}, record
    else:
        state = "starting" if is_stopped(old) else "reloading"
        new = (event.status or old._replace(restarts=0, hung=""))._replace(
            state=state, pid=old.pid, since_us=event.at_us
        )
        new = new._replace(machine=old.machine)
    return {**nodes, event.node: new._replace(asked=event.what, asked_by=event.by)}, record


_KEPT = ("kind", "policy", "max_restarts", "machine")


def lacking(nodes: NodeTable) -> dict[str, NodeStatus]:
    """The nodes that wait for what they need."""
    return {ident: node for ident, node in nodes.items() if node.state == "waiting"}


def held(nodes: NodeTable) -> dict[str, NodeStatus]:
    """The stopped nodes of which dora has a launcher, which waits."""
    return {ident: node for ident, node in nodes.items() if is_stopped(node) and node.pid}


def is_over_but_for_held(nodes: NodeTable) -> bool:
    """Return whether all nodes have ended, except stopped ones that may start again.

    False if all nodes were stopped by requests: then the dataflow stays running.
    """
    own = [node for node in nodes.values() if not is_stopped(node)]
    is_over = all(node.state in ("finished", "failed") for node in own)
    return bool(own) and is_over and bool(held(nodes))


def is_held_up(nodes: NodeTable) -> bool:
    """Whether the start waits for nothing but what nodes need."""
    done = ("waiting", "ready", "dynamic", "stopped")
    return bool(lacking(nodes)) and all(node.state in done for node in nodes.values())


def _needs(nodes: NodeTable, event: life.NodeLacks | life.NodeMet) -> Change:
    return _met(nodes, event) if isinstance(event, life.NodeMet) else _lacks(nodes, event)


def _lacks(nodes: NodeTable, event: life.NodeLacks) -> Change:
    old = nodes.get(event.node, NodeStatus())
    # The end of the node is shown as a wait: its earlier faults are over.
    ended: dict[str, str | int] = {"hung": "", "silent": "", "is_ended": False}
    nodes = _set(nodes, event.node, event.at_us, state="waiting", needs=event.needs, **ended)
    if old.state == "waiting":
        return nodes, None
    return nodes, Record("node-waiting", event.node, {"reason": event.needs})


def _met(nodes: NodeTable, event: life.NodeMet) -> Change:
    old = nodes.get(event.node, NodeStatus())
    if old.state != "waiting":
        return nodes, None
    # Dora counts the restarts of the process that waited from zero.
    nodes = _set(nodes, event.node, event.at_us, state="starting", needs="", restarts=0)
    after = format_duration(max(event.at_us - old.since_us, 0) // SECOND * SECOND)
    return nodes, Record("node-needs-met", event.node, {"reason": f"after {after}"})


def _hung(nodes: NodeTable, event: life.NodeHung) -> Change:
    """Record why a process is ended, for its exit. A process that has ended leaves no reason.

    dora's health check ends only processes that are ready: of another one the event comes too late.
    So does that of a member after the exit, which dora reports by another way.
    """
    if event.node not in nodes:
        return nodes, None
    old = nodes[event.node]
    is_late = event.is_late or old.state in ("restarting", "failed", "finished")
    if not is_late and (event.is_of_watchdog or old.is_alive):
        nodes = {**nodes, event.node: old._replace(hung=event.reason)}
    return nodes, Record(event.record, event.node, {"reason": event.reason, **event.details})


def _heard(nodes: NodeTable, event: life.NodeSilent | life.NodeSpeaks) -> Change:
    """Record that an owed output of a node is missing, or has arrived."""
    if event.node not in nodes:
        return nodes, None
    changed = nodes[event.node]._replace(silent=event.silent)
    details = {"output": event.output, "reason": event.reason}
    if isinstance(event, life.NodeSpeaks):
        return {**nodes, event.node: changed}, Record("node-speaks-again", event.node, details)
    changed = changed._replace(is_ended=event.then == RESTART)
    record = Record("node-silent", event.node, {**details, "then": event.then})
    return {**nodes, event.node: changed}, record


def _count(old: NodeStatus) -> int:
    """Return the restarts of a node, with the present one if dora reports a new process.

    Not counted before: a node that is stopped meanwhile is not restarted. Any event of the new
    process counts, because dora may report its execution before the exit of the old process.
    """
    return old.restarts + (old.state == "restarting")


def _spawned(nodes: NodeTable, event: life.NodeSpawned) -> Change:
    old = nodes.get(event.node, NodeStatus())
    if old.state == "failed" and old.policy == LATCHED:
        # Its launcher, which fails in its place: dora gives the node up.
        return {**nodes, event.node: old._replace(policy="never")}, None
    if old.state == "waiting":
        return {**nodes, event.node: old._replace(pid=event.pid)}, None
    if is_stopped(old):
        return {**nodes, event.node: old._replace(pid=event.pid, is_held=True)}, None
    at_us, pid = event.at_us, event.pid
    return _set(nodes, event.node, at_us, state="starting", pid=pid, restarts=_count(old)), None


def _exited(nodes: NodeTable, event: life.NodeExited, is_stopping: bool) -> Change:
    old = nodes.get(event.node, NodeStatus())
    is_told = was_asked(old) or old.state == "reloading"
    if is_told and not event.is_stale and (is_stopped(old) or not is_stopping):
        return _exited_as_told(nodes, event, old)
    if event.kept or (old.state == "waiting" and not is_stopping):
        # The process before this wait, or a launcher that was replaced: neither is a crash.
        pid = event.kept or (old.pid if event.is_stale else 0)
        return {**nodes, event.node: old._replace(pid=pid)}, None
    if _is_of_another(old, event):
        return nodes, None
    if event.will_restart and old.policy in (HELD, LATCHED):
        # Dora's restart is not one: it waits for a reload, or for what the node needs.
        event = replace(event, will_restart=False)
    if old.hung and event.exit.is_failure:  # the signal of the health check explains nothing
        event = replace(event, exit=Exit(ExitKind.HUNG, words=old.hung))
    elif old.is_ended:  # it may have exited with success, but not by itself
        event = replace(event, exit=Exit(ExitKind.SILENT, words=old.silent))
    record = _record_of(event, is_stopping)
    if event.is_stale and not event.will_restart:
        return nodes, None  # a newer process has replaced it
    if event.is_stale:  # dora reported the exit after it had executed the next one
        nodes = {**nodes, event.node: old._replace(restarts=old.restarts + 1, hung="")}
        return nodes, record
    nodes = _set(
        nodes,
        event.node,
        event.at_us,
        state=_state_after(event, is_stopping),
        pid=0,
        exit=event.exit,
        restarts=_count(old),
        hung="",
        silent="",
        is_ended=False,
        needs="",
    )
    return nodes, record


def _is_of_another(old: NodeStatus, event: life.NodeExited) -> bool:
    """Whether an exit after the end of a node is of another process.

    Such a process is the launcher, which ends as the node did, or the process before a reload.
    """
    is_launcher = old.state == "failed" and old.policy == "never" and event.exit == old.exit
    return is_launcher or (old.state in ("failed", "finished") and not (old.pid or old.machine))


def _exited_as_told(nodes: NodeTable, event: life.NodeExited, old: NodeStatus) -> Change:
    """Record an end that was requested or is part of a reload: no exit status is a crash then."""
    asked = {"asked": old.asked} if old.asked else {}
    record = Record("node-exited", event.node, {**event.exit.details(), **asked})
    if old.is_held:  # the exit of the launcher, which is no end of the node
        return {**nodes, event.node: old._replace(pid=0, is_held=False)}, None
    if is_stopped(old):
        return {**nodes, event.node: old._replace(pid=0, exit=event.exit)}, record
    if not was_asked(old):
        return _set(nodes, event.node, event.at_us, pid=0, state=old.state), record
    # Dora may refuse the next process, because this one has failed by itself.
    ended = _set(nodes, event.node, event.at_us, pid=0, state="starting", exit=event.exit)
    return ended, record


def with_downstream(record: Record, downstream: Downstream) -> Record:
    """Add the nodes downstream of a failed node to its life event."""
    fed = downstream.get(record.node)
    if record.event not in NODE_FAILURES or not fed:
        return record
    return replace(record, details={**record.details, "downstream": " ".join(fed)})


def _record_of(event: life.NodeExited, is_stopping: bool) -> Record:
    if event.oom is not None:
        return Record("node-oom", event.node, event.oom.node_details())
    if is_stopping or not event.exit.is_failure:
        return Record("node-exited", event.node, event.exit.details())
    # Nothing crashed: the runner or dora's health check has ended it.
    name = "node-ended" if event.exit.kind in (ExitKind.HUNG, ExitKind.SILENT) else "node-crashed"
    return Record(name, event.node, event.exit.details())


def _state_after(event: life.NodeExited, is_stopping: bool) -> str:
    if is_stopping:
        return "stopped"
    if event.will_restart:
        return "restarting"
    return "failed" if event.exit.is_failure else "finished"


def spent(nodes: NodeTable) -> dict[str, str]:
    """Return the last end of each node that has used up its restarts, by node."""
    return {
        ident: f"{str(node.exit) or 'ended'} after {counted(node.restarts, 'restart')}"
        for ident, node in nodes.items()
        if _is_spent(node)
    }


def _is_spent(node: NodeStatus) -> bool:
    if node.state == "failed":
        is_own = not node.exit.by and node.exit != EARLY
        return is_own and node.policy not in ("never", HELD, LATCHED)
    is_used_up = 0 < node.max_restarts <= node.restarts
    return node.state == "finished" and node.policy == "always" and is_used_up


def apply_results(nodes: NodeTable, results: Mapping[str, Exit], at_us: int) -> NodeTable:
    """Add dora's results to the table, which have causes that no event has."""
    for ident, how in results.items():
        if ident in nodes and is_stopped(nodes[ident]):
            continue
        if ident in nodes and (how.is_failure or nodes[ident].state not in ("failed", "stopped")):
            state = "failed" if how.is_failure else "finished"
            # For an OOM kill, dora only knows the signal.
            is_known = how == KILLED and nodes[ident].exit.is_failure
            exit = nodes[ident].exit if is_known else how
            nodes = _set(nodes, ident, at_us, state=state, exit=exit, pid=0)
    return nodes
