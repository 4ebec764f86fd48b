"""Who asks for the end of a dataflow: systemd notes that it was asked, and not by whom."""

import os
from collections.abc import Iterable, Mapping

from dora_systemd.adapters.journal.note import send_note
from dora_systemd.decisions.logs.events import event_fields
from dora_systemd.decisions.logs.fields import encode_entry
from dora_systemd.trust.paths import user_name
from dora_systemd.verbs.facts.cells import Cell


def note_stop(cells: Iterable[Cell], command: str = "doractl stop") -> None:
    """Write the event stop-asked for those dataflows that run. command: by which it is asked."""
    by = f"{caller(os.getuid(), os.environ)} ({command})"
    for cell in cells:
        if cell.is_up:
            fields = event_fields("stop-asked", dataflow=cell.name, by=by)
            own = {"DORA_DATAFLOW": cell.uuid, "DORA_DATAFLOW_NAME": cell.name}
            send_note(encode_entry({**fields, **own, "SYSLOG_IDENTIFIER": "doractl"}))


def caller(uid: int, environ: Mapping[str, str]) -> str:
    """A user's name; root by sudo(8) is told with the one who called it."""
    name = user_name(uid, nameless="the user ")
    behind = environ.get("SUDO_USER", "")
    return f"{name}, by sudo of {behind}" if uid == 0 and behind not in ("", "root") else name
