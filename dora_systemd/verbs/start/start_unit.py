"""`doractl start`: starts the unit of a dataflow, and waits for it."""

import select
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import (
    DOWN,
    JOB_DONE,
    ON_THE_WAY,
    Beside,
    Manager,
    Observer,
    Property,
    StageObserver,
    queued_job,
    tell_stage,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.needs.units import format_awaited, own_units
from dora_systemd.decisions.needs.waiting import START, format_wait
from dora_systemd.decisions.unit.systemd_versions import transient_commands
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.reason import job_reason, logs_hint, need_failure, runners_refusal
from dora_systemd.verbs.start.unit import systemd_number

_POLL_SECONDS = 0.2


class Started(NamedTuple):
    """A dataflow that has been started."""

    uuid: str
    name: str
    unit: str
    is_ready: bool  # whether its nodes are ready


def start_unit(
    manager: Manager,
    scope: Scope,
    options: RunnerOptions,
    properties: Sequence[Property] | None,
    on_stage: StageObserver | None,
    wait: bool,
    beside: Beside = (),
) -> Started:
    """Start the unit of a dataflow; if `wait`, wait until its nodes are ready.

    properties: of a transient unit; None for a unit that systemd has loaded. `beside`: the links of
    a dataflow on several machines. Raises DoraSystemdError with the reason when the start fails;
    the unit stays as failed. If the runner refuses the dataflow, no unit is left.
    """
    unit = unit_name(options.name)
    needed = _needed(manager, unit, properties)
    try:
        observe = partial(_tell, manager, unit, on_stage)
        result = _begin(manager, unit, properties, observe, wait, beside)
        if not wait:
            _wait_until_checked(manager, unit)
    except KeyboardInterrupt as error:
        raise _interruption(options.name) from error
    # A dataflow that finishes right after its start has not failed.
    state = manager.read(unit, ["ActiveState"])["ActiveState"]
    has_failed = result != JOB_DONE or state == "failed"
    if has_failed and (refusal := runners_refusal(manager, unit)):
        # It never ran, so do not keep its name in use. Links would only try once more.
        with suppress(DoraSystemdError):
            if beside:
                manager.run_jobs("StopUnit", [link for link, _ in beside])
            manager.reset_failed(unit)
        raise refusal
    if result == "dependency":
        reason, more = need_failure(manager, scope.flag, needed)
        raise DoraSystemdError(f"cannot start {options.name}: {reason}", f"{more} shows more")
    if has_failed and wait:
        result = "failed" if result == JOB_DONE else result
        raise _start_failure(manager, scope, unit, options.name, result)
    return Started(options.uuid, options.name, unit, is_ready=wait)


def _needed(manager: Manager, unit: str, properties: Sequence[Property] | None) -> list[str]:
    """The units that this one requires; systemd forgets a transient unit that it cannot start."""
    if properties is None:
        return list(manager.read(unit, ["Requires"])["Requires"] or ())
    return [one for name, _, value in properties if name == "Requires" for one in value]


def _tell(
    manager: Manager, unit: str, on_stage: StageObserver | None, changes: Mapping[str, Any]
) -> None:
    """Report the stage of a start; while systemd holds the start, report what it waits for."""
    tell_stage(on_stage, changes)
    if on_stage and not changes and (needs := format_awaited(manager.awaited(unit))):
        on_stage(format_wait(START, needs, 0))


def _begin(
    manager: Manager,
    unit: str,
    properties: Sequence[Property] | None,
    observe: Observer,
    wait: bool,
    beside: Beside,
) -> str:
    """Begin the start; the result of the job, which is that of a whole start only if `wait`."""
    if properties is not None:
        number = systemd_number(manager)
        links = [(link, transient_commands(of_it, number)) for link, of_it in beside]
        told = transient_commands(properties, number)
        return manager.start_transient(unit, told, observe, wait, links)
    if wait:
        return manager.run_jobs("StartUnit", [unit], observe)[unit]
    manager.queue_job("StartUnit", unit)
    return JOB_DONE


def format_started(started: Started, watched: Sequence[str] = ()) -> str:
    """The output of `doractl start`, similar to that of dora's own start.

    watched: patterns of the files that cause a reload, empty without hot reload.
    """
    done = "started" if started.is_ready else "starting"
    name = started.name
    more = " (hot-reload enabled)" if watched else ""
    watching = ("", "Watching for changes...", *(f"  - {one}" for one in watched))
    return "\n".join(
        (
            f"Dataflow {done}: {started.uuid}{more}",
            f"Name: {name}",
            f"Unit: {started.unit}",
            "",
            f"Use 'doractl stop {name}' to stop",
            "Use 'doractl list' to view status",
            f"Use 'doractl logs {name}' to view logs",
            *(watching if watched else ()),
        )
    )


def _interruption(name: str) -> DoraSystemdError:
    hint = f"doractl list {name} shows it, doractl stop {name} stops it"
    return DoraSystemdError(f"interrupted; {name} is still starting", hint, ExitCode.INTERRUPTED)


def _wait_until_checked(manager: Manager, unit: str) -> None:
    """Return once the runner has accepted the dataflow, or has ended, or systemd holds it."""
    while True:
        state = manager.read(unit, ["ActiveState", "Job", "StatusText"])
        is_on_the_way = state["ActiveState"] in ON_THE_WAY or queued_job(state)
        goes_on = state["StatusText"] and not state["StatusText"].startswith(FAILED_BECAUSE)
        # For a moment every start waits for its slice.
        is_held = state["ActiveState"] in DOWN and own_units(manager.awaited(unit))
        if goes_on or is_held or not is_on_the_way:
            return
        select.select([manager.fileno()], [], [], _POLL_SECONDS)
        manager.changes(unit)


def _start_failure(
    manager: Manager, scope: Scope, unit: str, name: str, result: str
) -> DoraSystemdError:
    reason = job_reason(manager, unit, result)
    hint = logs_hint(scope.flag, name, reason)
    return DoraSystemdError(f"cannot start {name}: {reason}", hint, ExitCode.FAILURE)
