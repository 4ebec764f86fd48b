"""`doractl stop`, `restart` and `reset`: what systemd does for several dataflows at once."""

from collections.abc import Iterable, Sequence
from contextlib import suppress

from dora_systemd.adapters.bus.manager import JOB_DONE, Manager, Observer
from dora_systemd.decisions.views.outcome import Outcome, Subject
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.reason import failure_reason, job_reason
from dora_systemd.verbs.start.asked import note_request
from dora_systemd.verbs.start.enable import read_boot_unit, release_transient


def stop_cells(
    manager: Manager, scope: Scope, cells: Sequence[Cell], observer: Observer | None = None
) -> list[Outcome]:
    """Stop dataflows in parallel, and wait until the last one has ended.

    Each has its own grace duration; after that systemd kills what is left.
    """
    up = [cell.unit for cell in cells if cell.is_up]
    results = manager.run_jobs("StopUnit", up, observer) if up else {}
    outcomes = [_stop_outcome(manager, cell, results.get(cell.unit)) for cell in cells]
    release_enabled(manager, scope, up)
    return outcomes


def release_enabled(manager: Manager, scope: Scope, units: Sequence[str]) -> None:
    """For dataflows that were enabled while running: let the unit file take effect."""
    is_one_lost = False
    for unit in sorted(enabled_units(manager, scope).intersection(units)):
        state = manager.read(unit, ["LoadState", "Transient", "ActiveState"])
        is_one_lost |= state["LoadState"] == "not-found"
        if state["Transient"] and state["ActiveState"] == "inactive":
            # If something references the transient unit, it stays: its text equals the file's.
            with suppress(DoraSystemdError):
                boot = read_boot_unit(manager, scope, unit)
                if boot.is_enabled:
                    release_transient(manager, boot)
    if is_one_lost:
        manager.reload()  # see lost_units()


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


def reset_cells(manager: Manager, cells: Sequence[Cell]) -> list[Outcome]:
    """Clear the restarts used up by each dataflow, and its failure; what runs goes on running.

    A failed unit that nothing else holds is gone from systemd then, its logs stay.
    """
    return [_reset(manager, cell) for cell in cells]


def note_stop(cells: Iterable[Cell], command: str = "doractl stop") -> None:
    """Write the event stop-asked for those dataflows that run. command: by which it is asked."""
    for cell in cells:
        if cell.is_up:
            note_request("stop-asked", cell.name, cell.uuid, command)


def not_running(subject: Subject, state: str) -> Outcome:
    """The outcome for a dataflow that need not be stopped. state: as in "has failed"."""
    text = f"Dataflow not running: {subject.uuid} ({subject.name} {state})"
    return Outcome(subject, text, is_news=False)


def _stop_outcome(manager: Manager, cell: Cell, result: str | None) -> Outcome:
    if result is None:
        ended = "has failed" if cell.state.active == "failed" else "does not run"
        return not_running(cell, ended)
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


def _reset(manager: Manager, cell: Cell) -> Outcome:
    used = manager.read(cell.unit, ["NRestarts"])["NRestarts"]
    manager.reset_failed(cell.unit)
    return Outcome(
        cell, f"Dataflow reset: {cell.uuid} ({cell.name}, restart counter reset, was {used})"
    )
