"""The live table of nodes: how each life event changes it. Pure."""

from collections.abc import Mapping
from dataclasses import replace
from signal import SIGKILL

from dora_systemd.decisions.cell.exits import Exit, ExitKind
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.life import events as life

Nodes = Mapping[str, NodeStatus]
RecordParts = tuple[str, str, Mapping[str, str]]
"""Name, node and details of the life event for the journal."""

_KILLED = Exit(ExitKind.SIGNAL, SIGKILL)
_WITH_PROCESS = frozenset({"starting", "ready", "running"})


def has_process(nodes: Nodes) -> bool:
    """Whether dora has a process of any node, according to the events so far."""
    return any(
        node.state in _WITH_PROCESS or (node.state == "reloading" and node.pid)
        for node in nodes.values()
    )


def all_ready(nodes: Nodes, at_us: int) -> Nodes:
    """The table after dora has opened its start barrier."""
    return {
        ident: node._replace(state="running", since_us=at_us) if node.state == "ready" else node
        for ident, node in nodes.items()
    }


def update(
    nodes: Nodes, event: life.Event, *, is_stopping: bool, is_open: bool
) -> tuple[Nodes, RecordParts | None]:
    """The table after a node's event, and the record for the journal.

    is_open: whether dora's start barrier is open; then a ready node runs, even if it is alone.
    """
    match event:
        case life.NodeSpawned():
            return _spawned(nodes, event)
        case life.NodeReady():
            state = "running" if is_open else "ready"
            return _set(nodes, event.node, event.at_us, state=state), ("node-ready", event.node, {})
        case life.NodeExited():
            return _exited(nodes, event, is_stopping)
        case life.NodeCascaded():
            exit = Exit(by=event.by)
            return _set(nodes, event.node, event.at_us, state="failed", exit=exit), None
        case life.NodeHung():
            return _hung(nodes, event)
    return nodes, None


def reshape(nodes: Nodes, event: life.Event) -> Nodes:
    """The table after a reload has changed the nodes."""
    match event:
        case life.NodeReloading():
            return _reloading(nodes, event)
        case life.NodeAdded():
            return {**nodes, event.node: event.status}
        case life.NodeRemoved():
            return {ident: node for ident, node in nodes.items() if ident != event.node}
    return nodes


def _set(nodes: Nodes, ident: str, at_us: int, **changes: str | int | Exit) -> Nodes:
    old = nodes.get(ident, NodeStatus())
    if changes.get("state") != old.state:
        changes["since_us"] = at_us
    return {**nodes, ident: old._replace(**changes)}  # type: ignore[arg-type]


def _reloading(nodes: Nodes, event: life.NodeReloading) -> Nodes:
    """The new process has its own restart counter."""
    old = nodes.get(event.node, NodeStatus())
    status = (event.status or old)._replace(state="reloading", pid=old.pid, since_us=event.at_us)
    return {**nodes, event.node: status}


def _hung(nodes: Nodes, event: life.NodeHung) -> tuple[Nodes, RecordParts | None]:
    if event.node not in nodes:
        return nodes, None
    nodes = {**nodes, event.node: nodes[event.node]._replace(hung=event.reason)}
    return nodes, ("node-hung", event.node, {"reason": event.reason})


def _spawned(nodes: Nodes, event: life.NodeSpawned) -> tuple[Nodes, RecordParts | None]:
    old = nodes.get(event.node, NodeStatus())
    nodes = _set(nodes, event.node, event.at_us, state="starting", pid=event.pid)
    if old.state != "restarting":
        return nodes, None
    return nodes, ("node-restarted", event.node, {"restarts": str(old.restarts)})


def _exited(
    nodes: Nodes, event: life.NodeExited, is_stopping: bool
) -> tuple[Nodes, RecordParts | None]:
    old = nodes.get(event.node, NodeStatus())
    if old.state == "reloading" and not is_stopping and not event.is_stale:
        nodes = {**nodes, event.node: old._replace(pid=0)}
        return nodes, ("node-exited", event.node, event.exit.details())
    if event.will_restart and old.policy == HELD:
        # The long delay in dora keeps this node down until a reload starts it again.
        event = replace(event, will_restart=False)
    if old.hung and event.exit.is_failure:  # the signal of the health check explains nothing
        event = replace(event, exit=Exit(ExitKind.HUNG, words=old.hung))
    name, details = _words_of(event, is_stopping)
    if event.is_stale and not event.will_restart:
        return nodes, None  # a newer process has replaced it
    if event.is_stale:  # dora reported the exit after it had executed the next one
        nodes = {**nodes, event.node: old._replace(restarts=old.restarts + 1)}
        return nodes, (name, event.node, details)
    nodes = _set(
        nodes,
        event.node,
        event.at_us,
        state=_state_after(event, is_stopping),
        pid=0,
        exit=event.exit,
        hung="",
        restarts=old.restarts + int(event.will_restart and not is_stopping),
    )
    return nodes, (name, event.node, details)


def _words_of(event: life.NodeExited, is_stopping: bool) -> tuple[str, Mapping[str, str]]:
    """Name and details of the record about the end of a node."""
    if event.oom is not None:
        return "node-oom", event.oom.node_details()
    name = "node-crashed" if event.exit.is_failure and not is_stopping else "node-exited"
    return name, event.exit.details()


def _state_after(event: life.NodeExited, is_stopping: bool) -> str:
    if is_stopping:
        return "stopped"
    if event.will_restart:
        return "restarting"
    return "failed" if event.exit.is_failure else "finished"


def spent(nodes: Nodes) -> dict[str, str]:
    """Nodes that have failed for good because their restarts are used up."""
    return {
        ident: f"{str(node.exit) or 'ended'} after {_restarts(node.restarts)}"
        for ident, node in nodes.items()
        if _is_spent(node)
    }


def _is_spent(node: NodeStatus) -> bool:
    if node.state == "failed":
        return node.policy not in ("never", HELD) and not node.exit.by
    is_used_up = 0 < node.max_restarts <= node.restarts
    return node.state == "finished" and node.policy == "always" and is_used_up


def _restarts(count: int) -> str:
    return "1 restart" if count == 1 else f"{count} restarts"


def apply_results(nodes: Nodes, results: Mapping[str, Exit], at_us: int) -> Nodes:
    """The table with dora's results, which have causes that no event has."""
    for ident, how in results.items():
        if ident in nodes and (how.is_failure or nodes[ident].state not in ("failed", "stopped")):
            state = "failed" if how.is_failure else "finished"
            # For an OOM kill, dora only knows the signal.
            is_known = how == _KILLED and nodes[ident].exit.is_failure
            exit = nodes[ident].exit if is_known else how
            nodes = _set(nodes, ident, at_us, state=state, exit=exit, pid=0)
    return nodes
