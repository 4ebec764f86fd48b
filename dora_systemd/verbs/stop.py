"""`doractl stop` and `doractl restart`: jobs of systemd, for several dataflows at once."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from dora_systemd.adapters.bus.manager import JOB_DONE, Manager, Observer
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.reason import failure_reason, job_reason


@dataclass(frozen=True)
class Outcome:
    """The result for one dataflow: `problem` is "" for success."""

    cell: Cell
    text: str
    problem: str = ""


def stop_cells(manager: Manager, scope: Scope, cells: Sequence[Cell]) -> list[Outcome]:
    """Stop dataflows in parallel, and wait until the last one has ended.

    Each has its own grace duration; after that systemd kills what is left.
    """
    up = [cell.unit for cell in cells if cell.is_up]
    results = manager.run_jobs("StopUnit", up) if up else {}
    outcomes = [_stop_outcome(manager, cell, results.get(cell.unit)) for cell in cells]
    release_enabled(manager, scope, up)
    return outcomes


def release_enabled(manager: Manager, scope: Scope, units: Sequence[str]) -> None:
    """For dataflows that were enabled while running: let the unit file take effect."""
    for unit in sorted(enabled_units(manager, scope).intersection(units)):
        state = manager.read(unit, ["Transient", "ActiveState"])
        if state["Transient"] and state["ActiveState"] == "inactive":
            from dora_systemd.verbs.start.enable import read_boot_unit, release_transient

            # If something references the transient unit, it stays: its text equals the file's.
            with suppress(DoraSystemdError):
                boot = read_boot_unit(manager, scope, unit)
                if boot.is_enabled:
                    release_transient(manager, boot)


def restart_cells(
    manager: Manager, cells: Sequence[Cell], observer: Observer | None = None
) -> list[Outcome]:
    """Stop and start dataflows in parallel, and wait until their nodes are ready.

    A requested restart resets the counter of automatic restarts.
    """
    for cell in cells:
        manager.hold(cell.unit)  # keep a failed transient unit and its failure
        manager.reset_failed(cell.unit)
    results = manager.run_jobs("RestartUnit", [cell.unit for cell in cells], observer)
    return [_restart_outcome(manager, cell, results[cell.unit]) for cell in cells]


def _stop_outcome(manager: Manager, cell: Cell, result: str | None) -> Outcome:
    if result is None:
        ended = "has failed" if cell.state.active == "failed" else "does not run"
        return Outcome(cell, f"Dataflow not running: {cell.uuid} ({cell.name} {ended})")
    if result != JOB_DONE:
        return Outcome(cell, "", f"cannot stop {cell.unit}: the job was {result}")
    state = manager.read(cell.unit, ["ActiveState", "Result"])
    note = ""
    if state["ActiveState"] == "failed":
        note = f": {failure_reason(manager, cell.unit)}"
    return Outcome(cell, f"Dataflow stopped: {cell.uuid} ({cell.name}){note}")


def _restart_outcome(manager: Manager, cell: Cell, result: str) -> Outcome:
    if result == JOB_DONE:
        return Outcome(cell, f"Dataflow restarted: {cell.uuid} ({cell.name})")
    reason = job_reason(manager, cell.unit, result)
    return Outcome(cell, "", f"cannot restart {cell.unit}: {reason}")
