"""Sends one record to the journal from a process that writes no others; loads less than `socket`.

Requests are recorded so: systemd records no caller, and forgets a unit that it has unloaded.

journald adds the user of the process, see _UID in systemd.journal-fields(7).
"""

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

from dora_systemd.decisions.logs.journal_events import event_fields
from dora_systemd.decisions.logs.lines import encode_entry
from dora_systemd.trust.paths import user_name

JOURNAL_SOCKET = "/run/systemd/journal/socket"


def send_note(entry: bytes, path: str = JOURNAL_SOCKET) -> None:
    """Send an entry in the native protocol; drop it if journald does not take it."""
    with (
        suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sock,
    ):
        sock.sendto(entry, path)


def note_request(event: str, name: str, uuid: str, command: str, **details: str) -> None:
    """Write an event about a dataflow in the name of this process.

    command: that makes the request, such as "doractl stop". details: as in event_fields().
    """
    by = requester(command)
    fields = event_fields(event, dataflow=name, by=by, **details)
    own = {"DORA_DATAFLOW": uuid, "DORA_DATAFLOW_NAME": name, "SYSLOG_IDENTIFIER": "doractl"}
    send_note(encode_entry({**fields, **own}))


def requester(command: str) -> str:
    """Format the user of this process and the command: "root (doractl stop)"."""
    return f"{caller(os.getuid(), os.environ)} ({command})"


def caller(uid: int, environ: Mapping[str, str]) -> str:
    """Format a user's name; for root by sudo(8) with the name of the user who called sudo."""
    name = user_name(uid, nameless="the user ")
    behind = environ.get("SUDO_USER", "")
    return f"{name}, by sudo of {behind}" if uid == 0 and behind not in ("", "root") else name
