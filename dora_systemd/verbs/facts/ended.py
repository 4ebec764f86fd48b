"""Finds dataflows that have ended and that systemd has unloaded, in the journal."""

import contextlib
from collections.abc import Sequence

from dora_systemd.adapters.journal.reader import JournalReader, LastEvent
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, STOPPED, DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import is_uuid_prefix, unit_name
from dora_systemd.scope import Scope

_WORDS = {"dataflow-finished": FINISHED, "dataflow-stopped": STOPPED, "dataflow-failed": FAILED}
_NO_END = "its end is not recorded: it was killed, or the machine went down"


def ended_rows(scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The ended dataflows that are not in `rows`, newest first."""
    known = {row.uuid for row in rows}
    return [ended_row(event) for event in _last_events(scope) if event.uuid not in known]


def select_ended(scope: Scope, selector: str) -> DataflowRow | None:
    """The newest ended dataflow that `selector` means, or None."""
    fits = (event for event in _last_events(scope) if is_meant(event, selector))
    event = next(fits, None)
    return None if event is None else ended_row(event)


def is_meant(event: LastEvent, selector: str) -> bool:
    """Whether `selector` is the dataflow's name, unit, UUID or the beginning of its UUID."""
    if selector in (event.name, unit_name(event.name)):
        return True
    return is_uuid_prefix(selector) and event.uuid.startswith(selector.lower())


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
