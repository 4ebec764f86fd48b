"""The last lines of a dataflow's nodes, to show after it has failed."""

import contextlib

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.query import scope_matches
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope

LINES = 10


def last_words(scope: Scope, uuid: str) -> list[str]:
    """The last lines of all nodes, oldest first, with their node; [] if they are not readable."""
    matches = [*scope_matches(scope), f"DORA_DATAFLOW={uuid}"]
    with contextlib.suppress(DoraSystemdError):
        records = list(JournalReader().newest(matches, LINES))
        return [_line(record) for record in reversed(records) if "DORA_EVENT" not in record]
    return []


def _line(record: dict[str, object]) -> str:
    message = record.get("MESSAGE")
    text = message if isinstance(message, str) else "(binary)"
    return f"{record.get('DORA_NODE', '')}: {text}"
