"""Finds dataflows that have ended: what systemd still knows of them, and the journal."""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.reader import (
    JournalReader,
    LastEvent,
    is_volatile,
    later_failures,
)
from dora_systemd.decisions.life.causes import BY_SIGKILL, NO_END
from dora_systemd.decisions.logs.journal_events import CLEAN_ENDS, FORGOTTEN
from dora_systemd.decisions.logs.query import request_matches
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, STOPPED, is_up_word
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.reason import failure_reason

_WORDS = {"dataflow-finished": FINISHED, "dataflow-stopped": STOPPED, "dataflow-failed": FAILED}
_MOST_NAMES = 100
_HIDDEN_SECONDS = 5.0
_TIMES = ("InactiveEnterTimestamp", "InactiveExitTimestamp", "ExecMainStartTimestamp")


def ended_rows(scope: Scope, rows: Sequence[DataflowRow] = ()) -> list[DataflowRow]:
    """The ended dataflows that are not in `rows`, newest first."""
    known = {row.uuid for row in rows}
    return [ended_row(event) for event in _last_events(scope) if event.uuid not in known]


def ended_of_name(scope: Scope, name: str) -> DataflowRow | None:
    """The newest ended dataflow of that name, or None.

    By the records of its unit alone, among which no other dataflow can write.
    """
    event = next(iter(_last_events(scope, limit=1, name=name)), None)
    return ended_row(event) if event else None


def not_recorded(error: DoraSystemdError) -> DoraSystemdError:
    """The error for a dataflow that is not in the journal either."""
    if not is_volatile() or error.code is not ExitCode.NOT_FOUND:
        return error
    told = f"{error.message}, and the journal is volatile: a reboot empties it"
    return DoraSystemdError(told, error.hint, error.code)


def newest_ended(
    manager: Manager, scope: Scope, rows: Sequence[DataflowRow], limit: int | None
) -> list[DataflowRow]:
    """Return the newest ended dataflow of each name that does not run, newest first.

    rows: all that systemd has loaded. limit: the maximum number of them, None: _MOST_NAMES.
    """
    limit = limit or _MOST_NAMES
    # A name that runs has its own row, but also an event.
    events = _last_events(scope, limit=limit + len(rows), is_by_name=True)
    known = {event.name: event for event in events}
    loaded = [_with_end(manager, row, known.get(row.name)) for row in rows if not is_up_word(row)]
    unloaded = [ended_row(known[name]) for name in known.keys() - {row.name for row in rows}]
    shown = sorted([*loaded, *unloaded], key=lambda row: (-row.ended, row.name))[:limit]
    return [with_cause(scope, row) for row in shown]


def with_cause(scope: Scope, row: DataflowRow) -> DataflowRow:
    """Return the row, with the verdict of `why` if no event of ours has recorded the whole end."""
    if row.text not in (NO_END, BY_SIGKILL):
        return row
    # Imported late: the end is recorded unless the machine went down, or nothing of ours ran; and
    # few end by SIGKILL, which `stop --now` sends.
    from dora_systemd.decisions.why.postmortem import examine
    from dora_systemd.decisions.why.verdict import Facts
    from dora_systemd.verbs.facts.lives import now_boot, read_lives

    with contextlib.suppress(DoraSystemdError):
        lives = read_lives(JournalReader(), scope, row.name, row.uuid, is_loaded=False)
        verdict = examine(lives, Facts(now_boot=now_boot()))
        if lives:
            return row._replace(
                status=verdict.status, text=verdict.summary, ended=verdict.at_us or row.ended
            )
    return row


def read_end(manager: Manager, scope: Scope, row: DataflowRow) -> DataflowRow:
    """Return the row of a loaded unit that is down, with the time and the reason of its end."""
    return _with_end(manager, row, next(iter(_last_events(scope, limit=1, name=row.name)), None))


def _with_end(manager: Manager, row: DataflowRow, event: LastEvent | None) -> DataflowRow:
    # The event has more facts than systemd, which unloads an enabled unit, too. But a failure
    # before the start of the runner has no event.
    times = manager.read(row.unit, (*_TIMES, "Result"))
    # A wait for a restart sets InactiveExitTimestamp=, too. After a stop that calls the restart off
    # the unit is inactive, with the result of its failure.
    is_called_off = row.status != FAILED and times["Result"] != "success"
    began = times["ExecMainStartTimestamp" if is_called_off else "InactiveExitTimestamp"]
    is_own = event and event.uuid == row.uuid and event.at_us >= began
    own = event if is_own else None
    row = row._replace(ended=times["InactiveEnterTimestamp"] or (own.at_us if own else 0))
    if own and own.event == "dataflow-failed":  # a stop that calls its restart off changes nothing
        return row._replace(status=FAILED, text=own.detail)
    if row.status != FAILED:
        return row
    return row._replace(text=failure_reason(manager, row.unit))


def ended_row(event: LastEvent) -> DataflowRow:
    """The row of `list --all` for a dataflow of which only the last life event is known."""
    word = _WORDS.get(event.event)
    return DataflowRow(
        uuid=event.uuid,
        name=event.name,
        unit=unit_name(event.name),
        status=word or FAILED,
        text=event.detail if word else NO_END,
        ended=event.at_us,
    )


def _last_events(scope: Scope, **what: Any) -> list[LastEvent]:
    # Without access to the journal, the rows from systemd are still shown.
    with contextlib.suppress(DoraSystemdError):
        journal = JournalReader()
        events = journal.last_events(scope, **what)
        if journal.is_cut and "name" not in what:
            events += _hidden(scope, {event.name for event in events})
            events.sort(key=lambda event: -event.at_us)
        return _with_later_failures(scope, _remembered(scope, events) if events else [])
    return []


def _hidden(scope: Scope, known: set[str]) -> list[LastEvent]:
    """The last event of each dataflow that is not in `known`, read by its unit.

    The nodes of one dataflow can write so many life events that a reading of all ends before
    those of the others.
    """
    journal, found = JournalReader(), list[LastEvent]()
    deadline = time.monotonic() + _HIDDEN_SECONDS
    for name in islice(journal.known_names(scope), _MOST_NAMES):
        if name not in known and time.monotonic() < deadline:
            found += journal.last_events(scope, 1, name)
    return found


def _remembered(scope: Scope, events: list[LastEvent]) -> list[LastEvent]:
    """The events without those from before their dataflow was forgotten."""
    at: dict[str, int] = {}
    for record in JournalReader().newest(request_matches(scope, FORGOTTEN), None):
        name = str(record.get("DORA_DATAFLOW_NAME", ""))
        at.setdefault(name, int(record["__REALTIME_TIMESTAMP"]))
    return [event for event in events if event.at_us > at.get(event.name, 0)]


def _with_later_failures(scope: Scope, events: list[LastEvent]) -> list[LastEvent]:
    """Return the events with later failed starts, which our code could not record.

    Such as when systemd cannot set up the sandbox for the second half of a restart. For dataflows
    of a user no record contains which dataflow has failed.
    """
    clean = [event for event in events if event.event in CLEAN_ENDS]
    if scope.is_user or not clean:
        return events
    failed: dict[str, int] = {}
    with contextlib.suppress(DoraSystemdError):
        failed = later_failures(clean)
    return [
        replace(event, event="dataflow-starting", at_us=failed[event.uuid], detail="")
        if event in clean and event.uuid in failed
        else event
        for event in events
    ]
