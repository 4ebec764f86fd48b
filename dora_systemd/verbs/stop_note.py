"""Records in the journal who requested a stop; systemd records only that one was requested."""

import os
import pwd
from collections.abc import Iterable, Mapping

from dora_systemd.adapters.journal.note import send_note
from dora_systemd.decisions.logs.events import event_fields
from dora_systemd.decisions.logs.fields import encode_entry
from dora_systemd.verbs.facts.cells import Cell


def note_stop(cells: Iterable[Cell], command: str = "doractl stop") -> None:
    """Write the event stop-asked for the dataflows that are running. command: for the record."""
    by = f"{caller(os.getuid(), os.environ)} ({command})"
    for cell in cells:
        if cell.is_up:
            fields = event_fields("stop-asked", dataflow=cell.name, by=by)
            own = {"DORA_DATAFLOW": cell.uuid, "DORA_DATAFLOW_NAME": cell.name}
            send_note(encode_entry({**fields, **own, "SYSLOG_IDENTIFIER": "doractl"}))


def caller(uid: int, environ: Mapping[str, str]) -> str:
    """The name of a user; for root by sudo(8), with the user who called sudo."""
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = f"the user {uid}"
    behind = environ.get("SUDO_USER", "")
    return f"{name}, by sudo of {behind}" if uid == 0 and behind not in ("", "root") else name
