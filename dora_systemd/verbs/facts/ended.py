"""Finds dataflows that have ended and that systemd has unloaded, in the journal."""

import contextlib
from collections.abc import Sequence

from dora_systemd.adapters.journal.reader import JournalReader, LastEvent, is_volatile
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, STOPPED, DataflowRow
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope

_WORDS = {"dataflow-finished": FINISHED, "dataflow-stopped": STOPPED, "dataflow-failed": FAILED}
_NO_END = "its end is not recorded: it was killed, or the machine went down"


def ended_rows(scope: Scope, rows: Sequence[DataflowRow] = ()) -> list[DataflowRow]:
    """The ended dataflows that are not in `rows`, newest first."""
    known = {row.uuid for row in rows}
    return [ended_row(event) for event in _last_events(scope) if event.uuid not in known]


def not_recorded(error: DoraSystemdError) -> DoraSystemdError:
    """The error for a dataflow that is not in the journal either."""
    if not is_volatile() or error.code is not ExitCode.NOT_FOUND:
        return error
    told = f"{error.message}, and the journal is volatile: a reboot empties it"
    return DoraSystemdError(told, error.hint, error.code)


def ended_row(event: LastEvent) -> DataflowRow:
    """The row of `list --all` for a dataflow of which only the last life event is known."""
    word = _WORDS.get(event.event)
    return DataflowRow(
        uuid=event.uuid,
        name=event.name,
        unit=unit_name(event.name),
        status=word or FAILED,
        text=event.detail if word else _NO_END,
        ended=event.at_us,
    )


def _last_events(scope: Scope) -> list[LastEvent]:
    # Without access to the journal, the rows from systemd are still shown.
    with contextlib.suppress(DoraSystemdError):
        return JournalReader().last_events(scope)
    return []
