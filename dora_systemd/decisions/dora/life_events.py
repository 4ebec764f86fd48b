"""Lines that dora's coordinator and daemon print become life events. Pure."""

import re
from collections.abc import Sequence
from dataclasses import replace

from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.status import NodeStatus, is_stopped
from dora_systemd.decisions.dora.protocol import NO_NODE, LogRecord, exit_value
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.resources.oom import Oom

_SPAWNED = r"spawned node with pid (\d+)"
_EXITED = r"handling node stop with exit status (\w+)(?:\((-?\d+)\))? \(restart: (true|false)"
_STALE = r"ignoring stale exit from pid (\d+) "
_RESTART_LOOP = r"not restarting node|max restarts|waiting .* before restart"
_UNRESPONSIVE = r"node `([^`]+)` (unresponsive for \d+ms \(timeout: [^)]*\)), killing"
_CASCADED = r"marking `(.+)` as cascading error caused by `(.+)`"


def parse_life_event(record: LogRecord, at_us: int) -> life.Event | None:
    """The life event that a line of dora's own means; None for other lines.

    Nodes cannot forge one: lines that they print have the level "stdout" or another target.
    """
    if record.target == "coordinator":
        return life.RunFinished(at_us) if record.message == "dataflow finished" else None
    if record.node:
        return _node_event(record, at_us) if record.target in ("daemon", "spawner") else None
    if record.target == "daemon" and record.message.endswith("starting dataflow"):
        return life.AllReady(at_us)
    return None


def _node_event(record: LogRecord, at_us: int) -> life.Event | None:
    if record.message == "node is ready":
        return life.NodeReady(at_us, record.node)
    if spawned := re.fullmatch(_SPAWNED, record.message):
        return life.NodeSpawned(at_us, record.node, int(spawned[1]))
    if exited := re.match(_EXITED, record.message):
        how = exit_value(exited[1], int(exited[2]) if exited[2] else None)
        return life.NodeExited(at_us, record.node, how, exited[3] == "true")
    if cascaded := re.match(_CASCADED, record.message):
        return life.NodeCascaded(at_us, cascaded[1], cascaded[2])
    return None


def parse_stale(record: LogRecord) -> int:
    """Return the pid if dora reports that the last exit was of a replaced or removed process, or 0.

    Dora reports that right after the exit, which has no pid.
    """
    stale = re.match(_STALE, record.message) if record.target == "daemon" else None
    return int(stale[1]) if stale else 0


def precedes_exit(record: LogRecord) -> bool:
    """Whether dora's restart loop prints this, of a process whose exit dora reports after that."""
    return record.target == "daemon" and re.match(_RESTART_LOOP, record.message) is not None


def parse_daemon_line(line: str, at_us: int) -> life.Event | None:
    """The event of a line printed by the daemon: dora reports hung nodes only there."""
    match = re.search(_UNRESPONSIVE, line)
    return life.NodeHung(at_us, match[1], match[2]) if match else None


def refused_request(
    node: str, before: NodeStatus, now: NodeStatus, reason: str, at_us: int
) -> Sequence[life.Event]:
    """The events of a requested restart or stop that dora refuses; none if a new process runs.

    before: the request. Dora also refuses a request for a node that has failed by itself just
    before: then its exit is the cause, which can also be received later.
    """
    if is_stopped(now):
        return _refused_stop(node, before, now, at_us)
    if now.state == "reloading" and before.may_run:
        return [life.NodeKept(at_us, node, before)]
    if now.pid:
        return []
    is_cause = NO_NODE in reason and now.exit.is_failure
    how = now.exit if is_cause else Exit(words=reason.removeprefix("cannot do that in "))
    return [life.NodeExited(at_us, node, how, will_restart=False)]


def _refused_stop(
    node: str, before: NodeStatus, now: NodeStatus, at_us: int
) -> Sequence[life.Event]:
    """The events by which a node is as before the request, or has ended by itself."""
    kept = life.NodeKept(at_us, node, before._replace(pid=now.pid))
    if now.exit.is_failure or (before.pid and not now.pid):
        return [kept, life.NodeExited(at_us, node, now.exit, will_restart=False)]
    return [kept]


def with_facts(
    event: life.NodeExited, is_stale: bool, oom: Oom | None, is_essential: bool = False
) -> life.NodeExited:
    """The event with facts that only the runner knows.

    is_stale: whether the node's current process is alive. oom: the OOM kill that ended it.
    is_essential: whether the dataflow needs the node.
    """
    oom = oom if event.exit.is_failure else None
    how = event.exit if oom is None else Exit(words=oom.text)
    return replace(event, exit=how, is_stale=is_stale, oom=oom, is_essential=is_essential)
