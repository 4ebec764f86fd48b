"""`doractl start`: a checked plan becomes a transient unit, and its start is waited for."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dora_systemd.busprotocol import JOB_DONE, Manager, Property
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.managercells import Cell, read_cell
from dora_systemd.managerplan import Plan
from dora_systemd.managerreason import job_reason
from dora_systemd.scope import Scope
from dora_systemd.statuswords import local_time

StageObserver = Callable[[str], None]
"""Is told the unit's STATUS= while its start is waited for."""

_FORGET_SECONDS = 2.0
_RETRY_SECONDS = 0.02


@dataclass(frozen=True)
class Started:
    """A dataflow that has been started. is_ready: its nodes are, too."""

    uuid: str
    name: str
    unit: str
    is_ready: bool


def require_free_name(manager: Manager, unit: str) -> None:
    """Make sure that `unit` can be made: a failed or ended dataflow of that name is forgotten.

    Raises DoraSystemdError (NAME_IN_USE), which says what runs there.
    """
    cell = read_cell(manager, unit)
    if cell is not None and cell.is_up:
        raise _in_use(manager, cell)
    state = manager.read(unit, ["LoadState", "Transient"])
    if state["LoadState"] == "not-found":
        return
    if cell is None or not state["Transient"]:
        raise DoraSystemdError(
            f"cannot start {unit}: a unit of that name is there already",
            f"see systemctl cat {unit}; choose another --name",
            ExitCode.NAME_IN_USE,
        )
    manager.reset_failed(unit)
    _wait_until_forgotten(manager, unit)


def start_plan(
    manager: Manager,
    plan: Plan,
    properties: Sequence[Property],
    on_stage: StageObserver | None,
    wait: bool,
) -> Started:
    """Start the unit of a plan and wait until its nodes are ready, unless told not to.

    Raises DoraSystemdError when the start fails, with the reason; the unit is left as failed then.
    """

    def observe(changes: Mapping[str, Any]) -> None:
        if on_stage and changes.get("StatusText"):
            on_stage(changes["StatusText"])

    try:
        result = manager.start_transient(plan.unit, properties, observe, wait)
    except KeyboardInterrupt as error:
        raise _interruption(plan.options.name) from error
    if result == JOB_DONE and wait and _has_failed(manager, plan.unit):
        result = "failed"
    if result != JOB_DONE:
        raise _start_failure(manager, plan.scope, plan.unit, plan.options.name, result)
    return Started(plan.options.uuid, plan.options.name, plan.unit, is_ready=wait)


def format_started(started: Started) -> str:
    """What `doractl start` prints, in the manner of dora's own start."""
    done = "started" if started.is_ready else "starting"
    name = started.name
    return "\n".join(
        (
            f"Dataflow {done}: {started.uuid}",
            f"Name: {name}",
            f"Unit: {started.unit}",
            "",
            f"Use 'doractl stop {name}' to stop",
            "Use 'doractl list' to view status",
            f"Use 'doractl logs {name}' to view logs",
        )
    )


def _in_use(manager: Manager, cell: Cell) -> DoraSystemdError:
    since = manager.read(cell.unit, ["InactiveExitTimestamp"])["InactiveExitTimestamp"]
    return DoraSystemdError(
        f"cannot start {cell.name}: dataflow {cell.uuid} of that name runs since "
        f"{local_time(since)} from {cell.options.dataflow}",
        f"doractl stop {cell.name}, or choose another --name",
        ExitCode.NAME_IN_USE,
    )


def _wait_until_forgotten(manager: Manager, unit: str) -> None:
    """systemd unloads a unit some time after nothing holds it any more."""
    deadline = time.monotonic() + _FORGET_SECONDS
    while manager.read(unit, ["LoadState"])["LoadState"] != "not-found":
        if time.monotonic() > deadline:
            raise DoraSystemdError(
                f"cannot start {unit}: systemd still holds the failed one",
                f"systemctl list-dependencies --reverse {unit}",
                ExitCode.NAME_IN_USE,
            )
        time.sleep(_RETRY_SECONDS)


def _interruption(name: str) -> DoraSystemdError:
    hint = f"it goes on starting: doractl list {name}, or doractl stop {name}"
    return DoraSystemdError(f"cannot wait for {name}: interrupted", hint, ExitCode.INTERRUPTED)


def _has_failed(manager: Manager, unit: str) -> bool:
    """A dataflow may end the moment it has started; one that ended well has started well."""
    return bool(manager.read(unit, ["ActiveState"])["ActiveState"] == "failed")


def _start_failure(
    manager: Manager, scope: Scope, unit: str, name: str, result: str
) -> DoraSystemdError:
    reason = job_reason(manager, unit, result)
    hint = f"doractl logs {name}, or systemctl {scope.flag} status {unit}"
    return DoraSystemdError(f"cannot start {name}: {reason}", hint, ExitCode.FAILURE)
