"""Who inhibits restarts of a dataflow, as text and as JSON. Pure.

The kernel knows who holds a lock. The lock file only has the reasons, a line "PID TEXT" for each.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.decisions.views.formats import UNKNOWN
from dora_systemd.decisions.views.rows import Holder
from dora_systemd.errors import usage_error
from dora_systemd.terminal_text import cut, short_line

_HEADER = ("NAME", "NODE", "PID", "USER", "COMMAND", "WHY")
_COMMAND_WIDTH = 40
_MOST_BYTES = 200


class Inhibited(NamedTuple):
    """A dataflow and the processes that inhibit its restart."""

    name: str
    uuid: str
    unit: str
    holders: tuple[Holder, ...]


def format_holder(holder: Holder) -> str:
    """Format one holder, such as "node arm (PID 231, user dora, python arm.py): it moves"."""
    details = (
        f"PID {holder.pid}" if holder.pid else "",
        f"user {holder.user}" if holder.user else "",
        _command(holder) if holder.node else "",
    )
    name = f"node {holder.node}" if holder.node else _command(holder)
    known = ", ".join(filter(None, details))
    who = f"{name or 'an unknown process'}{known and f' ({known})'}"
    return f"{who}: {holder.why}" if holder.why else who


def format_holders(holders: Sequence[Holder]) -> str:
    """The first holder, and how many more there are."""
    first, *more = map(format_holder, holders)
    return f"{first}; and {len(more)} more" if more else first


def format_inhibited(rows: Sequence[Inhibited], width: int | None, want_colors: bool) -> str:
    """The table of `doractl inhibit`, for a terminal of that width."""
    cells = [_cells(row.name, holder) for row in rows for holder in row.holders]
    return format_table(_HEADER, cells, width, want_colors)


def _cells(name: str, holder: Holder) -> tuple[str, ...]:
    pid = str(holder.pid) if holder.pid else ""
    found = (name, holder.node, pid, holder.user, _command(holder), holder.why)
    return tuple(one or UNKNOWN for one in found)


def _command(holder: Holder) -> str:
    """The command line for a table, its paths without directories."""
    line = short_line(holder.command, _MOST_BYTES)
    words = (word.rpartition("/")[2] or word for word in line.split())
    return cut(" ".join(words), _COMMAND_WIDTH)


def inhibited_objects(rows: Sequence[Inhibited]) -> list[Mapping[str, Any]]:
    """Return what `doractl inhibit -o json` prints: an object for each lock."""
    return [
        {"name": row.name, "uuid": row.uuid, "unit": row.unit, **holder.values()}
        for row in rows
        for holder in row.holders
    ]


MAX_REASON = 200
"""Bytes of a reason that are shown."""
_MAX_DIGITS = 10


def parse_reason(text: str) -> str:
    """A reason as `--why` takes it, in one line. Raises DoraSystemdError (USAGE) if it is empty."""
    reason = short_line(text, MAX_REASON)
    if not reason:
        raise usage_error("cannot inhibit without a reason", "such as --why 'it is driving'")
    return reason


def format_reason(pid: int, reason: str) -> bytes:
    """The line of a process in the lock file."""
    return f"{pid} {reason}\n".encode(errors="replace")


def parse_reasons(data: bytes) -> Mapping[int, str]:
    """The reasons in a lock file by pid, the last line of each; other lines do not count.

    A pid is that of the PID namespace in which the process runs, see pid_namespaces(7).
    """
    found = {}
    for line in data.decode(errors="replace").split("\n"):
        pid, _, text = line.partition(" ")
        if pid.isascii() and pid.isdigit() and len(pid) <= _MAX_DIGITS:
            found[int(pid)] = short_line(text, MAX_REASON)
    return found
