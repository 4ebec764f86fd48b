"""Who inhibits restarts of a dataflow, for people and for programs. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.decisions.views.formats import UNKNOWN
from dora_systemd.decisions.views.rows import Holder
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
    """One holder in a line, such as "node arm (PID 231, user dora, python arm.py): it moves"."""
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
    """What `doractl inhibit -o json` prints: an object for each lock."""
    return [
        {"name": row.name, "uuid": row.uuid, "unit": row.unit, **holder.values()}
        for row in rows
        for holder in row.holders
    ]
