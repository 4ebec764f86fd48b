"""The table of `doractl list`, from facts of systemd and the runner."""

from collections.abc import Sequence
from itertools import pairwise

from dora_systemd.decisions.needs.waiting import format_wait
from dora_systemd.decisions.views.facts import SILENT, stopping_words
from dora_systemd.decisions.views.formats import (
    UNKNOWN,
    format_count,
    format_memory,
    format_percent,
    format_uptime,
    local_time,
)
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.terminal_text import cut, one_line

STARTING, WAITING, RUNNING, DEGRADED = "Starting", "Waiting", "Running", "Degraded"
STOPPING, RESTARTING = "Stopping", "Restarting"
FROZEN = "Frozen"
"""The status of a frozen unit, see `systemctl freeze`."""
FINISHED, STOPPED, FAILED = "Finished", "Stopped", "Failed"
UNREACHABLE = "Unreachable"
"""The status in the row of a host that did not answer."""
UP_WORDS = frozenset({STARTING, WAITING, RUNNING, DEGRADED, STOPPING, RESTARTING, FROZEN})

_BY_ACTIVE = {
    "active": RUNNING,
    "reloading": RUNNING,
    "refreshing": RUNNING,
    "activating": STARTING,
    "deactivating": STOPPING,
    "maintenance": STOPPING,
    "failed": FAILED,
    "inactive": STOPPED,
}
_ALIVE = ("activating", "active", "reloading", "refreshing")
_BY_STAGE = {"degraded": DEGRADED, "unmet": WAITING, "stopping": STOPPING}

UNREADABLE = "?"
"""The count of nodes of a dataflow whose node table is not valid."""
SHORTEST_PREFIX = 8


def status_word(active: str, sub: str, stage: str = "", is_held: bool = False) -> str:
    """The status of a dataflow in one word.

    active, sub: ActiveState and SubState of its unit, see org.freedesktop.systemd1(5). stage: the
    runner's own, or "" if that is not readable. is_held: whether systemd has its start in the
    queue.
    """
    if is_held:
        return WAITING
    if sub.startswith("auto-restart") or (active == "activating" and stage == "restarting"):
        return RESTARTING
    if active in _ALIVE and stage == "gathering":
        return WAITING
    word = _BY_ACTIVE.get(active, STOPPED)
    return _BY_STAGE.get(stage, word) if word == RUNNING else word


def shortest_prefixes(uuids: Sequence[str]) -> dict[str, str]:
    """The shortest unique prefix of each UUID, at least SHORTEST_PREFIX characters."""
    ordered = sorted(set(uuids))
    # No other UUID has more in common with one than its neighbours in the order.
    shared = [0, *(_shared(one, other) for one, other in pairwise(ordered)), 0]
    lengths = (max(two) + 1 for two in pairwise(shared))
    return {
        uuid: uuid[: max(length, SHORTEST_PREFIX)]
        for uuid, length in zip(ordered, lengths, strict=False)  # without UUIDs there is a length
    }


def _shared(one: str, other: str) -> int:
    """The number of characters that two texts begin with in common."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((at for at, (left, right) in pairs if left != right), min(len(one), len(other)))


_OPTIONAL = (
    *("PYTHON", "DORA", "FILES", "CREATED", "SIZE", "EVENT", "WRITTEN"),
    *("RELEASE", "BOOT", "PEAK", "PID", "THROTTLED%", "RESTARTS"),
    *("UPTIME", "WAITS FOR", "MEM", "CPU%", "WATCHDOG", "NODES", "UUID", "MACHINE"),
)
"""Columns that a narrow terminal does without, in this order."""
_LEAST = 12
_ROOM = {
    **dict.fromkeys(("HOST", "NAME", "NODE", "EXIT", "COMMAND"), _LEAST),
    **dict.fromkeys(("WHY", "STATUS TEXT"), 24),
}
"""Columns whose cells may be cut to _LEAST, and the width for which other columns are left out."""
_RIGHT_ALIGNED = frozenset(
    {"CPU%", "THROTTLED%", "MEM", "PEAK", "RESTARTS", "PID", "UPTIME", "WATCHDOG"}
)
_ANSI = {"red": "\x1b[31m", "yellow": "\x1b[33m"}
_UNDERLINED, _PLAIN = "\x1b[4m", "\x1b[0m"
STATE_COLORS = {
    **dict.fromkeys((FAILED, UNREACHABLE), "red"),
    **dict.fromkeys(
        (STARTING, WAITING, DEGRADED, STOPPING, RESTARTING, FROZEN, SILENT, "Reloading"), "yellow"
    ),
}
"""Colours by the text of a state, as in systemctl(1); other states have none."""


def colored_state(text: str, word: str) -> str:
    """`text` with the first `word` in it in the colour of that state."""
    color = STATE_COLORS.get(word)
    return text.replace(word, f"{_ANSI[color]}{word}{_PLAIN}", 1) if color else text


def format_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int | None = None,
    want_colors: bool = False,
) -> str:
    """Columns with two blanks between them, numbers right-aligned, without trailing blanks.

    width: of the terminal. Then the least important columns are left out, and long texts cut, until
    the table fits. Nothing in a cell can control the terminal.
    """
    columns = [[one_line(cell) for cell in column] for column in zip(header, *rows, strict=True)]
    if width is not None:
        _fit(columns, width)
    aligned = zip(*(_aligned(column, want_colors) for column in columns), strict=True)
    titles, *lines = ("  ".join(cells).rstrip() for cells in aligned)
    return "\n".join([f"{_UNDERLINED}{titles}{_PLAIN}" if want_colors else titles, *lines])


def _fit(columns: list[list[str]], width: int) -> None:
    """Leave out columns, and cut texts, the last column first."""
    for title in _OPTIONAL:
        slack = sum(max(_width(one) - _ROOM.get(one[0], _width(one)), 0) for one in columns)
        if _excess(columns, width) <= slack:
            break
        columns[:] = [one for one in columns if one[0] != title]
    for least in (_ROOM, dict.fromkeys(_ROOM, _LEAST)):
        for column in reversed(columns):
            if column[0] in least and (excess := _excess(columns, width)) > 0:
                room = max(_width(column) - excess, least[column[0]])
                column[:] = [cut(cell, room) for cell in column]


def _width(column: Sequence[str]) -> int:
    return max(map(len, column))


def _excess(columns: Sequence[Sequence[str]], width: int) -> int:
    """Return by how many characters the table is wider than `width`."""
    return sum(map(_width, columns)) + 2 * (len(columns) - 1) - width


def _aligned(column: Sequence[str], want_colors: bool) -> list[str]:
    adjust = str.rjust if column[0] in _RIGHT_ALIGNED else str.ljust
    width = _width(column)
    cells = [adjust(cell, width) for cell in column]
    if want_colors and column[0] in ("STATUS", "STATE"):
        return [colored_state(cell, cell.partition(" ")[0]) for cell in cells]
    return cells


_HEADER = ("UUID", "NAME", "STATUS", "UPTIME", "NODES", "CPU%", "MEM", "RESTARTS", "BOOT")


def format_dataflows(
    rows: Sequence[DataflowRow], width: int | None = None, want_colors: bool = False
) -> str:
    """The table of `doractl list`, for a terminal of that width.

    With RELEASE if any of them is deployed, with ENDED if any has ended, and with WHY if any has
    ended, waits, is degraded, or stops and has nodes with times of their own.
    """
    return format_table(*dataflow_table(rows), width, want_colors)


def dataflow_table(rows: Sequence[DataflowRow]) -> tuple[Sequence[str], list[Sequence[str]]]:
    """The header of that table, and the cells of each row."""
    prefixes = shortest_prefixes([row.uuid for row in rows])
    optional = {
        "RELEASE": any(row.release for row in rows),
        "ENDED": not all(map(is_up_word, rows)),
        "WHY": any(map(_has_why, rows)),
    }
    header = [*_HEADER, *(title for title, is_shown in optional.items() if is_shown)]
    cells = [_dataflow_cells(row, prefixes[row.uuid]) for row in rows]
    return header, [[row[title] for title in header] for row in cells]


def _dataflow_cells(row: DataflowRow, prefix: str) -> dict[str, str]:
    return {
        "UUID": prefix,
        "NAME": row.name,
        "STATUS": row.status,
        "UPTIME": format_uptime(row.uptime),
        "NODES": node_count(row) or UNKNOWN,
        "CPU%": format_percent(row.cpu_percent, row.cpu_limit),
        "MEM": format_memory(row.memory, row.memory_limit),
        "RESTARTS": format_count(row.restarts),
        "BOOT": "yes" if row.enabled else UNKNOWN,
        "RELEASE": row.release or UNKNOWN,
        "ENDED": local_time(row.ended),
        "WHY": _why(row) or UNKNOWN,
    }


_WITH_WHY = (WAITING, DEGRADED)
WITH_NODES = (*_WITH_WHY, STOPPING)
"""The statuses of dataflows whose nodes the table names."""


def _has_why(row: DataflowRow) -> bool:
    is_stopping = row.status == STOPPING and stopping_words(row.nodes)
    return row.status in _WITH_WHY or not is_up_word(row) or bool(is_stopping)


def _why(row: DataflowRow) -> str:
    """Format how the dataflow ended, what it waits for, or which nodes have failed."""
    if row.status == STOPPING:
        return stopping_words(row.nodes)
    if row.status == DEGRADED:
        failed = (one for one in row.nodes if one.word == FAILED)
        return ", ".join(f"node {one.node}: {one.exit}" for one in failed) or row.text
    if row.status != WAITING:
        return "" if is_up_word(row) else row.text
    nodes = (format_wait(one.node, one.needs, one.since) for one in row.nodes if one.needs)
    return ", ".join(nodes) or row.text


def node_count(row: DataflowRow) -> str:
    """The number of running and of all nodes, as in "2/3", or "" if the dataflow has none."""
    if row.problem:
        return UNREADABLE
    return f"{row.nodes_alive}/{row.nodes_total}" if row.nodes_total else ""


def is_up_word(row: DataflowRow) -> bool:
    """Whether the dataflow is running, starting or stopping."""
    return row.status in UP_WORDS
