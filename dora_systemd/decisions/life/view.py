"""How a cell is shown: STATUS= of its unit, and the table in status.json."""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.cell.restarts import HELD_SECONDS, LATCH_SECONDS
from dora_systemd.decisions.cell.status import (
    FAILED_BECAUSE,
    GATHERING,
    HELD,
    LATCHED,
    UNMET,
    CellStatus,
    NodeStatus,
    is_stopped,
)
from dora_systemd.decisions.life.node_table import WITH_PROCESS, is_held_up, lacking
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.life.stop_order import has_order, in_turn
from dora_systemd.decisions.needs.waiting import format_wait
from dora_systemd.decisions.resources.usage import CpuSample, LineCount
from dora_systemd.decisions.watchdog.messages import Sign
from dora_systemd.values import INFINITY, format_duration

_SHOWN = {
    State.BOOTING: ("starting", "starting the dora coordinator"),
    State.JOINING: ("starting", "starting the dora daemon"),
    State.GATHERING: (GATHERING, ""),
    State.STARTING: ("starting", "starting the nodes"),
    State.WAITING: ("waiting", ""),
    State.RUNNING: ("running", ""),
    State.STOPPING: ("stopping", ""),
    State.CLOSING: ("stopping", "asking dora how the dataflow ended"),
    State.LEAVING: ("stopping", "stopping the dora daemon"),
    State.ENDED: ("ended", ""),
}
"""Stage and STATUS= of each state; "" if the text depends on more."""
_NAMED = 5
"""Maximum nodes that a status line names."""


def format_status(cell: Cell) -> str:
    """Format one line for STATUS=, see sd_notify(3)."""
    if cell.failure:
        return f"{FAILED_BECAUSE}{cell.failure}"
    if text := _format_gathering(cell) or _SHOWN[cell.state][1]:
        return text
    if cell.state is State.ENDED:
        return "stopped" if cell.stop_by else "finished"
    if cell.state is State.STOPPING:
        return _format_stopping(cell)
    return _format_waiting(cell) if cell.state is State.WAITING else _format_running(cell)


def _format_gathering(cell: Cell) -> str:
    """Format what a machine waits for before its run; "" otherwise."""
    if cell.machine and cell.state in (State.BOOTING, State.GATHERING):
        return "waiting for the head"
    if cell.state is not State.GATHERING:
        return ""
    return cell.awaited or f"waiting for {_names(list(cell.members))}"


def _format_stopping(cell: Cell) -> str:
    left = [ident for ident, node in cell.nodes.items() if node.state in WITH_PROCESS]
    if not left:
        return "stopping"
    if has_order(cell) or cell.ending:
        now, later = in_turn(cell)
        return f"stopping, waiting for {_names(now)}" + (f", then {_names(later)}" if later else "")
    text = f"stopping, waiting for {_names(left)}"
    if cell.grace == INFINITY:
        return text
    return f"{text} (killed if not ended within {format_duration(kill_delay(cell.grace))})"


def _format_waiting(cell: Cell) -> str:
    waiting = [ident for ident, node in cell.nodes.items() if node.state == "starting"]
    failed = [_with_exit(*one) for one in cell.nodes.items() if one[1].state == "failed"]
    text = f"{_count(cell, 'ready', 'dynamic')}/{len(cell.nodes)} nodes ready"
    text = f"{text}, waiting for {_names(waiting)}" if waiting else text
    text = f"{text}; {_format_lacking(cell)}" if lacking(cell.nodes) else text
    return f"{text}; failed: {_names(failed)}" if failed else text


def _format_running(cell: Cell) -> str:
    alive = sum(node.is_alive for node in cell.nodes.values())
    parts = [f"{alive}/{len(cell.nodes)} nodes running"]
    for state in ("starting", "restarting", "reloading", "finished", "failed"):
        nodes = {ident: node for ident, node in cell.nodes.items() if node.state == state}
        if nodes:
            parts.append(f"{state}: {_names([_with_exit(*one) for one in nodes.items()])}")
    if stopped := [ident for ident, node in cell.nodes.items() if is_stopped(node)]:
        parts.append(f"stopped: {_names(stopped)}")
    silent = [f"{ident} ({node.silent})" for ident, node in cell.nodes.items() if node.silent]
    if silent:
        parts.append(f"silent: {_names(silent)}")
    if lacking(cell.nodes):
        parts.append(_format_lacking(cell))
    if cell.notice:
        parts.append(cell.notice)
    return "; ".join(parts)


def _format_lacking(cell: Cell) -> str:
    """Format "camera waits for /dev/video0 since 14:02:11 UTC"."""
    nodes = lacking(cell.nodes).items()
    return _names([format_wait(ident, node.needs, node.since_us) for ident, node in nodes])


def _with_exit(ident: str, node: NodeStatus) -> str:
    return f"{ident} ({node.exit})" if node.exit.is_failure and not node.asked else ident


def _names(texts: list[str]) -> str:
    more = len(texts) - _NAMED
    return ", ".join(texts[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _count(cell: Cell, *states: str) -> int:
    return sum(node.state in states for node in cell.nodes.values())


def stage(cell: Cell) -> str:
    """Return the stage, one of dora_systemd.decisions.cell.status.STAGES."""
    if cell.state is State.RUNNING and any(map(_is_missed, cell.nodes.values())):
        return "degraded"
    if lacking(cell.nodes) and has_started(cell):
        return UNMET
    return _SHOWN[cell.state][0]


def _is_missed(node: NodeStatus) -> bool:
    return node.state == "failed" or bool(node.silent)


def is_waiting_only(cell: Cell) -> bool:
    """Whether the start waits for nothing but what nodes need."""
    return cell.state is State.WAITING and is_held_up(cell.nodes)


def has_started(cell: Cell) -> bool:
    """Whether the unit counts as started: a wait for a device must not keep the boot waiting."""
    return cell.state is State.RUNNING or is_waiting_only(cell)


def is_up(cell: Cell) -> bool:
    """Whether READY=1 is due: the dataflow has started, or ends well without a start.

    systemd calls the end of a service that was never ready a failure, whatever its exit status.
    """
    ends_well = cell.exit in (RunnerExit.OK, RunnerExit.FAILED_AT_STOP) and not cell.reload
    return has_started(cell) or (cell.state is State.ENDED and ends_well)


def cell_status(
    cell: Cell,
    uuid: str,
    samples: tuple[CpuSample, ...],
    lines: Mapping[str, LineCount],
    signs: Mapping[str, Sign],
) -> CellStatus:
    """Return the table for status.json."""
    return CellStatus(
        uuid=uuid,
        run=cell.run,
        stage=stage(cell),
        text=format_status(cell),
        started_us=cell.started_us,
        ready_us=cell.ready_us,
        nodes=dict(cell.nodes),
        samples=samples,
        lines=lines,
        signs=signs,
    )


def _policy(raw: Mapping[str, Any]) -> str:
    if raw.get("restart_delay") == HELD_SECONDS:
        return HELD
    if raw.get("restart_delay") == LATCH_SECONDS:
        return LATCHED
    return raw.get("restart_policy") or "never"


def _max_restarts(raw: Mapping[str, Any]) -> int:
    return 0 if _policy(raw) == LATCHED else int(raw.get("max_restarts") or 0)


def initial_nodes(
    kinds: Mapping[str, str], descriptor: Mapping[str, Any], at_us: int
) -> dict[str, NodeStatus]:
    """Return the initial table of nodes.

    kinds: node id -> how dora starts it. descriptor: as sent to dora.
    """
    raw = {node["id"]: node for node in descriptor["nodes"]}
    return {
        ident: NodeStatus(
            state="dynamic" if kind == "dynamic" else "starting",
            kind=kind,
            since_us=at_us,
            policy=_policy(raw[ident]),
            max_restarts=_max_restarts(raw[ident]),
        )
        for ident, kind in kinds.items()
    }
