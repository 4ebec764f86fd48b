"""`doractl start`: a checked plan becomes a transient unit, and its start is waited for."""

import select
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from dora_systemd.adapters.bus.manager import JOB_DONE, ON_THE_WAY, Manager, Observer, Property
from dora_systemd.adapters.dora.command import version_numbers
from dora_systemd.decisions.life.refusal import FAILED
from dora_systemd.decisions.unit.versions import MIN_VERSION, transient_commands
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.reason import job_reason, runners_refusal
from dora_systemd.verbs.start.plan import Plan

_POLL_SECONDS = 0.2

StageObserver = Callable[[str], None]
"""Is told the unit's STATUS= while its start is waited for."""


@dataclass(frozen=True)
class Started:
    """A dataflow that has been started. is_ready: its nodes are, too."""

    uuid: str
    name: str
    unit: str
    is_ready: bool


def start_plan(
    manager: Manager,
    plan: Plan,
    properties: Sequence[Property],
    on_stage: StageObserver | None,
    wait: bool,
) -> Started:
    """Start the transient unit of a plan and wait until its nodes are ready, unless told not to.

    Raises DoraSystemdError when the start fails, with the reason; the unit is left as failed then.
    What its runner refuses was never started: nothing is left of that.
    """
    number = next(iter(version_numbers(manager.version())), MIN_VERSION)
    told = transient_commands(properties, number)
    return _started(
        manager,
        plan,
        lambda observe: manager.start_transient(plan.unit, told, observe, wait),
        on_stage,
        wait,
    )


def start_unit_file(
    manager: Manager, plan: Plan, on_stage: StageObserver | None, wait: bool
) -> Started:
    """The same for a plan whose unit is a file that systemd has read."""

    def start(observe: Observer) -> str:
        if wait:
            return manager.run_jobs("StartUnit", [plan.unit], observe)[plan.unit]
        manager.queue_job("StartUnit", plan.unit)
        return JOB_DONE

    return _started(manager, plan, start, on_stage, wait)


def _started(
    manager: Manager,
    plan: Plan,
    start: Callable[[Observer], str],
    on_stage: StageObserver | None,
    wait: bool,
) -> Started:
    def observe(changes: Mapping[str, Any]) -> None:
        if on_stage and changes.get("StatusText"):
            on_stage(changes["StatusText"])

    try:
        result = start(observe)
        if not wait:
            _wait_until_checked(manager, plan.unit)
    except KeyboardInterrupt as error:
        raise _interruption(plan.options.name) from error
    has_failed = result != JOB_DONE or _has_failed(manager, plan.unit)
    if has_failed and (refusal := runners_refusal(manager, plan.unit)):
        # It never ran: its name is as free as before.
        with suppress(DoraSystemdError):
            manager.reset_failed(plan.unit)
        raise refusal
    if has_failed and wait:
        result = "failed" if result == JOB_DONE else result
        raise _start_failure(manager, plan.scope, plan.unit, plan.options.name, result)
    return Started(plan.options.uuid, plan.options.name, plan.unit, is_ready=wait)


def format_started(started: Started, watched: Sequence[str] = ()) -> str:
    """What `doractl start` prints, in the manner of dora's own start.

    watched: patterns of the files that mean a reload, none without hot reload.
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
    """Return when the runner has said that it goes on, or has ended."""
    while True:
        state = manager.read(unit, ["ActiveState", "Job", "StatusText"])
        is_on_the_way = state["ActiveState"] in ON_THE_WAY or (state["Job"] or (0,))[0]
        goes_on = state["StatusText"] and not state["StatusText"].startswith(FAILED)
        if goes_on or not is_on_the_way:
            return
        select.select([manager.fileno()], [], [], _POLL_SECONDS)
        manager.changes(unit)


def _has_failed(manager: Manager, unit: str) -> bool:
    """A dataflow may end the moment it has started; one that ended well has started well."""
    return bool(manager.read(unit, ["ActiveState"])["ActiveState"] == "failed")


def _start_failure(
    manager: Manager, scope: Scope, unit: str, name: str, result: str
) -> DoraSystemdError:
    reason = job_reason(manager, unit, result)
    hint = f"doractl {scope.flag} why {name} tells more"
    return DoraSystemdError(f"cannot start {name}: {reason}", hint, ExitCode.FAILURE)
