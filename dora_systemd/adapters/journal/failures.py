"""systemd's own records of failures: our code may not have run any more to record one.

Only the system's manager records whose failure it is, see LogExtraFields= in systemd.exec(5).
"""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.adapters.journal.reader import JournalReader, LastEvent
from dora_systemd.decisions.logs.query import failure_matches
from dora_systemd.names import unit_name

_MOST_RECORDS = 1000


def later_failures(events: Sequence[LastEvent]) -> dict[str, int]:
    """By UUID, when the unit of a dataflow has failed after its event, CLOCK_REALTIME µs.

    Raises DoraSystemdError.
    """
    known = {event.uuid: event for event in events}
    found: dict[str, int] = {}
    for record in JournalReader().newest(failure_matches(list(known)), _MOST_RECORDS):
        event = known.get(str(record.get("DORA_DATAFLOW", "")))
        if event and record.get("UNIT") == unit_name(event.name) and _is_after(record, event):
            found.setdefault(event.uuid, int(record["__REALTIME_TIMESTAMP"]))
    return found


def _is_after(record: Mapping[str, Any], event: LastEvent) -> bool:
    """By the order in the journal: the clock may have been set back in between."""
    source, number = _place(str(record.get("__CURSOR", "")))
    own_source, own_number = _place(event.cursor)
    if source and source == own_source:
        return number > own_number
    return int(record["__REALTIME_TIMESTAMP"]) > event.at_us


def _place(cursor: str) -> tuple[str, int]:
    """Of a record, see "Cursor" in the Journal Export Formats: by whom it is counted, and its
    number."""
    fields = dict(part.partition("=")[::2] for part in cursor.split(";"))
    return fields.get("s", ""), int(fields.get("i", "0"), 16)
