"""Counts the restarts that a dataflow has left, from systemd and the journal."""

import time
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from dora_systemd.adapters.bus.manager import SETTLED, Manager
from dora_systemd.decisions.cell.restarts import restart_of, unit_budget
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.views.dataflows import RESTARTING
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY
from dora_systemd.verbs.facts.cells import Cell

_READY_SINCE = "ActiveEnterTimestampMonotonic"
_PROPERTIES = ("NRestarts", "StartLimitBurst", "StartLimitIntervalUSec", _READY_SINCE)
_WAITING = ("RestartUSec", "StateChangeTimestampMonotonic")
_MOST_STARTS = 1000


def restart_budget(
    manager: Manager, scope: Scope, cell: Cell, status: CellStatus
) -> Mapping[str, int | None] | None:
    """The restarts of a unit, or None if systemd restarts it never, or without a limit.

    status: from its runner. used, max: numbers of restarts. next_us, resets_us: µs until the next
    restart, and until the counter is reset; None: neither will happen.
    """
    if manager.read(cell.unit, ["Restart"])["Restart"] == "no":
        return None
    facts = manager.read(cell.unit, _PROPERTIES)
    window = facts["StartLimitIntervalUSec"]
    if window in (0, INFINITY):
        return None
    # systemd's limit has room for starts by hand; a drop-in can make it smaller.
    most = max(min(facts["StartLimitBurst"] - 1, restart_of(cell.options).max_restarts), 0)
    budget = unit_budget(
        _starts(scope, cell.name, facts["NRestarts"], (cell.uuid, cell.state, facts[_READY_SINCE])),
        most,
        window,
        time.time_ns() // 1000,
        facts["NRestarts"],
    )
    return {
        "used": budget.used,
        "max": most,
        "next_us": _next(manager, cell, status),
        "resets_us": budget.resets_in,
    }


@lru_cache
def _starts(scope: Scope, name: str, restarts: int, _life: object) -> list[int]:
    """Read the starts that NRestarts= counts, and the start before them; CLOCK_REALTIME µs.

    _life: part of the key of the cache, because `top` and the page call this often: the journal is
    only read again for another life or state.
    """
    if not restarts:
        return []
    # Imported only after a restart, because the journal is slow.
    from dora_systemd.adapters.journal.reader import JournalReader

    try:
        found = JournalReader().starts(scope, name, min(restarts + 1, _MOST_STARTS))
    except DoraSystemdError:
        return []
    return sorted(found)


def _next(manager: Manager, cell: Cell, status: CellStatus) -> int | None:
    """The delay in µs: systemd waits for the shortest one, the runner for the rest."""
    if cell.word(status.stage) != RESTARTING:
        return None
    if not cell.awaits_restart:
        return max(status.started_us - time.time_ns() // 1000, 0)
    facts: dict[str, Any] = manager.read(cell.unit, _WAITING)
    now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    policy = restart_of(cell.options)
    delay = max(int(facts["RestartUSec"]), 0 if policy.policy == "no" else policy.delay)
    return max(int(facts["StateChangeTimestampMonotonic"]) + delay - now, 0)


def read_restarts(manager: Manager, cell: Cell) -> int:
    """Read from systemd how often it has restarted the unit of a dataflow."""
    counted = int(manager.read(cell.unit, ["NRestarts"])["NRestarts"])
    return without_refused(manager, cell, counted)


def without_refused(manager: Manager, cell: Cell, counted: int) -> int:
    """The restarts that have happened. counted: NRestarts=.

    NRestarts= counts the restart that the runner has refused, too, because no restart was left.
    """
    if not counted or cell.state.active in SETTLED:
        return counted
    status = manager.read(cell.unit, ["ExecMainStatus"])["ExecMainStatus"]
    return counted - 1 if status == RunnerExit.RESTARTS_SPENT else counted
