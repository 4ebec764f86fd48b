"""`doractl stop` and `reset`: what systemd does for several dataflows at once."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import DOWN, JOB_DONE, Manager, Observer, is_at_rest
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.decisions.life.stop_budget import kill_delay
from dora_systemd.decisions.views.outcome import Outcome, Subject
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import exists
from dora_systemd.values import INFINITY, SECOND, format_duration
from dora_systemd.verbs.facts.budget import read_restarts
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells
from dora_systemd.verbs.facts.containers import find_outside, with_left
from dora_systemd.verbs.facts.enabled import enabled_units, own_directories, trial_path
from dora_systemd.verbs.facts.reason import failure_reason

UNBOUNDED_SECONDS = 90.0
"""Timeout for a dataflow with TimeoutStopSec=infinity: systemd's own default."""

_MARGIN_SECONDS = 5.0
_MICROSECOND_NS = 1000
KILLED_SECONDS = 10.0
"""Timeout for the end of processes that were killed."""
POLL_SECONDS = 0.05
THAWED = "thawed first, it was frozen"
"""Note about a frozen unit: systemd refuses to stop such a unit, and may hang if it is killed."""

Clock = Callable[[], float]


class Ended(NamedTuple):
    """A dataflow with a requested stop."""

    cell: Cell
    note: str = ""  # how it ended, or ""
    problem: str = ""  # why it has not


class _Stop(NamedTuple):
    cell: Cell
    deadline: float  # seconds of the monotonic clock
    is_killed: bool
    was_frozen: bool = False


def stop_cells(
    manager: Manager, scope: Scope, cells: Sequence[Cell], observer: Observer | None = None
) -> list[Outcome]:
    """Stop dataflows in parallel, and wait until the last one has ended.

    Each has its own grace duration; after that systemd kills what is left.
    """
    up = [cell.unit for cell in cells if cell.is_up]
    thawed = {unit for unit in up if manager.thaw(unit)}
    outside = find_outside(manager, up)
    begin = time.time_ns() // _MICROSECOND_NS
    results = manager.run_jobs("StopUnit", up, observer) if up else {}
    outcomes = [
        _stop_outcome(manager, scope, cell, results.get(cell.unit), begin, cell.unit in thawed)
        for cell in cells
    ]
    end_links_of(manager, cells)
    release_enabled(manager, scope, up)
    drop_disabled(manager, scope, [cell.unit for cell in cells])
    return with_left(outcomes, outside)


def stop_cells_within(
    manager: Manager, scope: Scope, cells: Sequence[Cell], most: int
) -> list[Outcome]:
    """Stop dataflows as stop_cells() does, and kill those that still run after `most` µs."""
    up = [cell for cell in cells if cell.is_up]
    outside = find_outside(manager, [cell.unit for cell in up])
    ended = {one.cell: one for one in stop_within(manager, up, most)}
    end_links_of(manager, cells)
    release_enabled(manager, scope, [cell.unit for cell in up])
    drop_disabled(manager, scope, [cell.unit for cell in cells])
    outcomes = [
        Outcome(cell, _stopped(cell, ended[cell].note), ended[cell].problem)
        if cell in ended
        else _not_running(cell)
        for cell in cells
    ]
    return with_left(outcomes, outside)


def stop_within(
    manager: Manager, cells: Sequence[Cell], most: int | None, now: Clock = time.monotonic
) -> Iterator[Ended]:
    """Stop dataflows in parallel; yields each as soon as it has ended.

    most: µs until it is killed, at once for 0; None: the TimeoutStopSec= of the unit.
    """
    pending = [_begin(manager, cell, most, now()) for cell in cells]
    while pending:
        left = []
        for one in pending:
            state = manager.read(one.cell.unit, ["ActiveState"])["ActiveState"]
            if state in DOWN:
                yield _ended(manager, one, state)
            elif now() < one.deadline:
                left.append(one)
            elif not one.is_killed:
                again = _begin(manager, one.cell, 0, now())
                left.append(again._replace(was_frozen=one.was_frozen))
            else:
                text = f"cannot stop {one.cell.unit}: it is {state} although it was killed"
                yield Ended(one.cell, problem=text)
        pending = left
        if pending:
            time.sleep(POLL_SECONDS)


def release_enabled(manager: Manager, scope: Scope, units: Sequence[str]) -> None:
    """Let the unit files of dataflows take effect that were enabled while running."""
    enabled = enabled_units(manager, scope).intersection(units)
    if not enabled:
        return
    # Imported late: it takes as long as all that stops a dataflow which is not enabled.
    from dora_systemd.verbs.start.enable import read_boot_unit, release_transient

    is_one_lost = False
    for unit in sorted(enabled):
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


def drop_disabled(manager: Manager, scope: Scope, units: Sequence[str]) -> None:
    """Remove the unit files of inactive dataflows that were disabled while running."""
    if not units:
        return
    with suppress(DoraSystemdError):
        directory = own_directories(manager, scope)[1]
        left = [directory / unit for unit in units if exists(directory / unit)]
        if disabled := [one for one in left if _is_disabled(manager, scope, one)]:
            # Imported late, as above; and hardly ever needed.
            from dora_systemd.verbs.start.enable import remove_files

            remove_files(manager, disabled)


def _is_disabled(manager: Manager, scope: Scope, copy: Path) -> bool:
    """Whether it is what `disable` has kept of a dataflow that ran, and is of no more use."""
    from dora_systemd.adapters.host.unit_files import read_unit_file
    from dora_systemd.decisions.unit.file import is_without_install

    with suppress(DoraSystemdError):
        state = manager.read(copy.name, ["ActiveState", "Job"])
        # A failed one can be started again, and what is on trial may go back to it.
        is_over = is_at_rest(state) and state["ActiveState"] == "inactive"
        is_needed = not is_over or exists(trial_path(scope, copy.name))
        return not is_needed and is_without_install(read_unit_file(copy) or "", copy.name)
    return False


def end_links_of(manager: Manager, cells: Sequence[Cell]) -> None:
    """End the links of those that were the head of several machines, and have ended.

    Another command may have restarted a head instead: that needs its links.
    """
    known = ((cell.unit, cell.known_options) for cell in cells)
    heads = [(unit, one.name) for unit, one in known if one and one.placed and not one.machine]
    ended = [name for unit, name in heads if is_at_rest(manager.read(unit, ["ActiveState", "Job"]))]
    if ended:
        # Imported late: most dataflows run on one machine.
        from dora_systemd.verbs.start.start import end_links

        for name in ended:
            end_links(manager, name)


def reset_cells(manager: Manager, scope: Scope, cells: Sequence[Cell]) -> list[Outcome]:
    """Clear the used restarts and the failure of each dataflow; running dataflows keep running.

    A failed unit that nothing else holds is gone from systemd then, its logs stay.
    """
    outcomes = [_reset(manager, cell) for cell in cells]
    drop_disabled(manager, scope, [cell.unit for cell in cells])
    return outcomes


def note_stop(cells: Iterable[Cell], command: str = "doractl stop") -> None:
    """Write the event stop-asked for those dataflows that run; a restart stops them, too.

    command: that makes the request.
    """
    for cell in cells:
        if cell.is_up:
            note_request("stop-asked", cell.name, cell.uuid, command)


def not_running(subject: Subject, state: str) -> Outcome:
    """The outcome for a dataflow that need not be stopped. state: as in "has failed"."""
    text = f"Dataflow not running: {subject.uuid} ({subject.name} {state})"
    return Outcome(subject, text, is_news=False)


def _stop_outcome(
    manager: Manager, scope: Scope, cell: Cell, result: str | None, begin: int, was_frozen: bool
) -> Outcome:
    """begin: of the stop, CLOCK_REALTIME µs."""
    if result is None:
        return _not_running(cell)
    if result != JOB_DONE:
        return Outcome(cell, "", f"cannot stop {cell.unit}: the job was {result}")
    state = manager.read(cell.unit, ["ActiveState", "Result"])
    is_failed = state["ActiveState"] == "failed"
    note = failure_reason(manager, cell.unit) if is_failed else _killed(scope, cell, begin)
    return Outcome(cell, _stopped(cell, _joined(THAWED if was_frozen else "", note)))


def _killed(scope: Scope, cell: Cell, begin: int) -> str:
    """The nodes that had to be killed since then. Only a slow stop needs the journal."""
    options = cell.options
    stops = options.by_node("stop")
    delay = min([kill_delay(options.grace), *(one.within for one in stops.values() if one.within)])
    if time.time_ns() // _MICROSECOND_NS - begin < delay:
        return ""
    # Imported late: most stops are fast.
    from dora_systemd.adapters.journal.reader import JournalReader

    nodes = []
    with suppress(DoraSystemdError):
        nodes = JournalReader().killed_since(scope, cell.name, cell.uuid, begin)
    after = "their time" if stops else format_duration(delay)
    return f"killed after {after}: {', '.join(nodes)}" if nodes else ""


def _let_go(manager: Manager, unit: str) -> None:
    """Clear the failure of a unit, and close what systemd keeps of a recorder that has failed."""
    manager.reset_failed(unit)
    facts = manager.read(unit, ["ActiveState", "NFileDescriptorStore"])
    if facts["ActiveState"] in DOWN and facts["NFileDescriptorStore"]:
        manager.close_stored(unit)


def _stopped(cell: Cell, note: str) -> str:
    return f"Dataflow stopped: {cell.uuid} ({cell.name}){note and f': {note}'}"


def _not_running(cell: Cell) -> Outcome:
    return not_running(cell, "has failed" if cell.state.active == "failed" else "does not run")


def _reset(manager: Manager, cell: Cell) -> Outcome:
    used = read_restarts(manager, cell)
    _let_go(manager, cell.unit)
    return Outcome(
        cell, f"Dataflow reset: {cell.uuid} ({cell.name}, restart counter reset, was {used})"
    )


def _begin(manager: Manager, cell: Cell, most: int | None, now: float) -> _Stop:
    """Stop a dataflow in any state: the job replaces a start or restart that is queued."""
    given = manager.read(cell.unit, ["TimeoutStopUSec"])["TimeoutStopUSec"]
    thawed = manager.thaw(cell.unit)
    manager.queue_job("StopUnit", cell.unit)
    seconds = given / SECOND if given and given != INFINITY else UNBOUNDED_SECONDS
    seconds += _MARGIN_SECONDS
    if most is not None and most <= 0:
        # There may be no process, as between two restarts.
        with suppress(DoraSystemdError):
            manager.kill(cell.unit, signal.SIGKILL)
        # ExecStopPost= runs now, for which systemd allows as much time again.
        return _Stop(cell, now + max(KILLED_SECONDS, seconds), True, thawed)
    limit = seconds if most is None else min(seconds, most / SECOND)
    return _Stop(cell, now + limit, False, thawed)


def _ended(manager: Manager, one: _Stop, state: str) -> Ended:
    note = ""
    if one.is_killed:
        with suppress(DoraSystemdError):
            _let_go(manager, one.cell.unit)
        note = "killed"
    elif state == "failed":
        note = failure_reason(manager, one.cell.unit)
    return Ended(one.cell, _joined(THAWED if one.was_frozen else "", note))


def _joined(*notes: str) -> str:
    return ", ".join(filter(None, notes))


def find_dependents(manager: Manager, cells: Sequence[Cell]) -> list[Cell]:
    """The running dataflows that need one of `cells`, or need one that does, without `cells`."""
    needed, waiting = {cell.unit for cell in cells}, [cell.unit for cell in cells if cell.is_up]
    found: set[str] = set()
    while waiting:
        by = set(manager.read(waiting.pop(), ["RequiredBy"])["RequiredBy"] or ())
        new = by - found - needed
        found |= new
        waiting += sorted(new)
    if not found:
        return []
    return proven(one for one in read_cells(manager) if one.unit in found and one.is_up)


def format_dependents(needed: Sequence[Subject], dependents: Sequence[Subject]) -> str:
    """Format "needy needs base and ends with it"; "" without any."""
    if not dependents:
        return ""
    names, bases = (", ".join(one.name for one in some) for some in (dependents, needed))
    verb, end = ("needs", "ends") if len(dependents) == 1 else ("need", "end")
    return f"{names} {verb} {bases} and {end} with {'it' if len(needed) == 1 else 'them'}"
