"""Formats dataflows for `doractl list`, from facts of systemd and the runner."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.restarts import budget_words
from dora_systemd.values import SECOND, format_rounded_size

STARTING, RUNNING, DEGRADED = "Starting", "Running", "Degraded"
STOPPING, RESTARTING = "Stopping", "Restarting"
FINISHED, STOPPED, FAILED = "Finished", "Stopped", "Failed"
UP_WORDS = frozenset({STARTING, RUNNING, DEGRADED, STOPPING, RESTARTING})

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
_BY_STAGE = {"degraded": DEGRADED, "stopping": STOPPING}

UNKNOWN = "-"
UNREADABLE = "?"
"""For the nodes of a dataflow whose node table is not valid."""
SHORTEST_PREFIX = 8


class NodeRow(NamedTuple):
    """One row of `list SELECTOR`. Sizes in bytes, cpu in percent of one processor, None: unknown.

    cpu_limit, memory_limit: the group's own, or None. throttled: the percentage of the time in
    which its CPU limit throttled it, None without one. since: time of its last change of state,
    CLOCK_REALTIME µs, 0: unknown.
    """

    node: str
    state: str
    pid: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    restarts: int | None = None
    max_restarts: int | None = None
    exit: str = ""
    cpu_limit: float | None = None
    memory_limit: int | None = None
    throttled: float | None = None
    since: int = 0


class DataflowRow(NamedTuple):
    """One row of `list`. uptime in µs; started, ended in CLOCK_REALTIME µs, 0: unknown.

    Other fields are as in NodeRow, for the whole dataflow. enabled: whether it is started at boot.
    problem: why its node table is not valid, or "".
    """

    uuid: str
    name: str
    unit: str
    status: str
    dataflow: str = ""
    text: str = ""
    uptime: int | None = None
    started: int = 0
    ended: int = 0
    nodes_alive: int = 0
    nodes_total: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    cpu_limit: float | None = None
    memory_limit: int | None = None
    throttled: float | None = None
    restarts: int | None = None
    restart_budget: Mapping[str, int | None] | None = None
    nodes: tuple[NodeRow, ...] = ()
    enabled: bool = False
    problem: str = ""


def status_word(active: str, sub: str, stage: str = "") -> str:
    """The status of a dataflow in one word.

    active, sub: ActiveState and SubState of its unit, see org.freedesktop.systemd1(5). stage: the
    runner's own, or "" if that is not readable.
    """
    if sub.startswith("auto-restart") or (active == "activating" and stage == "restarting"):
        return RESTARTING
    word = _BY_ACTIVE.get(active, STOPPED)
    return _BY_STAGE.get(stage, word) if word == RUNNING else word


def format_uptime(duration: int | None) -> str:
    """`duration` µs as "00:05:32", from one day on with "1d " in front."""
    if duration is None:
        return UNKNOWN
    minutes, seconds = divmod(duration // SECOND, 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    clock = f"{hours:02}:{minutes:02}:{seconds:02}"
    return f"{days}d {clock}" if days else clock


def format_percent(percent: float | None) -> str:
    """One decimal, as in "12.5"."""
    return UNKNOWN if percent is None else f"{percent:.1f}"


def format_cpu(row: DataflowRow | NodeRow) -> str:
    """Percent of one processor, as in "12.5", or "12.5/50" with a limit."""
    text = format_percent(row.cpu_percent)
    return text if row.cpu_limit is None else f"{text}/{row.cpu_limit:g}"


def format_memory(size: int | None, limit: int | None = None) -> str:
    """Bytes for a table, as in "256M", or "256M/4G" with a limit."""
    text = UNKNOWN if size is None else format_rounded_size(size)
    return text if limit is None else f"{text}/{format_rounded_size(limit)}"


def format_count(count: int | None) -> str:
    """A number, or the sign for unknown."""
    return UNKNOWN if count is None else str(count)


def shortest_prefixes(uuids: Sequence[str]) -> dict[str, str]:
    """The shortest unique prefix of each UUID, at least SHORTEST_PREFIX characters."""
    return {uuid: _prefix(uuid, [one for one in uuids if one != uuid]) for uuid in uuids}


def _prefix(uuid: str, others: Sequence[str]) -> str:
    lengths = range(SHORTEST_PREFIX, len(uuid))
    free = (n for n in lengths if not any(one.startswith(uuid[:n]) for one in others))
    return uuid[: next(free, len(uuid))]


_RIGHT_ALIGNED = frozenset({"CPU%", "THROTTLED%", "MEM", "PEAK", "RESTARTS", "PID", "UPTIME"})


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns with two blanks between them, numbers right-aligned, without trailing blanks."""
    lines = [header, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(header))]
    return "\n".join(_line(header, line, widths) for line in lines)


def _line(header: Sequence[str], cells: Sequence[str], widths: Sequence[int]) -> str:
    aligned = (
        cell.rjust(width) if title in _RIGHT_ALIGNED else cell.ljust(width)
        for title, cell, width in zip(header, cells, widths, strict=True)
    )
    return "  ".join(aligned).rstrip()


_HEADER = ("UUID", "NAME", "STATUS", "UPTIME", "NODES", "CPU%", "MEM", "RESTARTS", "BOOT")


def format_dataflows(rows: Sequence[DataflowRow]) -> str:
    """The table of `doractl list`."""
    prefixes = shortest_prefixes([row.uuid for row in rows])
    return format_table(_HEADER, [_dataflow_cells(row, prefixes[row.uuid]) for row in rows])


def _dataflow_cells(row: DataflowRow, prefix: str) -> tuple[str, ...]:
    return (
        prefix,
        row.name,
        row.status,
        format_uptime(row.uptime),
        node_count(row) or UNKNOWN,
        format_percent(row.cpu_percent),
        format_memory(row.memory, row.memory_limit),
        format_count(row.restarts),
        "yes" if row.enabled else UNKNOWN,
    )


def node_count(row: DataflowRow) -> str:
    """The number of running and of all nodes, as in "2/3", or "" if the dataflow has none."""
    if row.problem:
        return UNREADABLE
    return f"{row.nodes_alive}/{row.nodes_total}" if row.nodes_total else ""


def format_nodes(rows: Sequence[NodeRow]) -> str:
    """The node table of `doractl list SELECTOR`; with THROTTLED% if any node has a CPU limit."""
    cells = [_node_cells(row) for row in rows]
    is_limited = any(row.cpu_limit is not None for row in rows)
    header = [title for title in cells[0] if is_limited or title != _THROTTLED]
    return format_table(header, [[row[title] for title in header] for row in cells])


_THROTTLED = "THROTTLED%"


def _node_cells(row: NodeRow) -> dict[str, str]:
    return {
        "NODE": row.node,
        "STATE": row.state.capitalize(),
        "PID": str(row.pid) if row.pid else UNKNOWN,
        "CPU%": format_cpu(row),
        _THROTTLED: format_percent(row.throttled),
        "MEM": format_memory(row.memory, row.memory_limit),
        "PEAK": format_memory(row.memory_peak),
        "RESTARTS": _restarts_of(row),
        "EXIT": row.exit or UNKNOWN,
    }


def _restarts_of(row: NodeRow) -> str:
    used = format_count(row.restarts)
    return f"{used}/{row.max_restarts}" if row.max_restarts else used


_WITH_REASON = (FAILED, DEGRADED, RESTARTING)


def format_dataflow(row: DataflowRow) -> str:
    """The output of `doractl list SELECTOR`: the dataflow's values, then the table of its nodes."""
    facts = (
        ("Dataflow", row.uuid),
        ("Name", row.name),
        ("Unit", row.unit),
        ("File", row.dataflow or UNKNOWN),
        ("Status", f"{row.status} ({row.text})" if row.text else row.status),
        ("Uptime", format_uptime(row.uptime)),
        ("Started", local_time(row.started)),
        ("Ended", local_time(row.ended) if row.ended else ""),
        ("Nodes", row.problem),
        ("CPU", _cpu_words(row)),
        ("Memory", _memory_words(row)),
        ("Restarts", format_count(row.restarts)),
        ("Budget", budget_words(row.restart_budget) if row.restart_budget else ""),
        ("At boot", "started" if row.enabled else ""),
        ("Reason", f"doractl why {row.name}" if row.status in _WITH_REASON else ""),
    )
    lines = [f"{title + ':':<10}{text}" for title, text in facts if text]
    return "\n".join([*lines, "", format_nodes(row.nodes)] if row.nodes else lines)


def _cpu_words(row: DataflowRow) -> str:
    now = UNKNOWN if row.cpu_percent is None else f"{row.cpu_percent:.1f}%"
    if row.cpu_limit is None:
        return now
    return f"{now} of {row.cpu_limit:g}%, throttled {format_percent(row.throttled)}% of the time"


def _memory_words(row: DataflowRow) -> str:
    now = format_memory(row.memory)
    if row.memory_limit is not None:
        now = f"{now} of {format_memory(row.memory_limit)}"
    return now if row.memory_peak is None else f"{now} (peak {format_memory(row.memory_peak)})"


def local_time(moment: int) -> str:
    """CLOCK_REALTIME µs as "2026-01-15 13:00:00" in the local time zone; 0 is unknown."""
    if not moment:
        return UNKNOWN
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(moment / SECOND))


def is_up_word(row: DataflowRow) -> bool:
    """Whether the dataflow is running, starting or stopping."""
    return row.status in UP_WORDS


def row_values(row: DataflowRow) -> dict[str, Any]:
    """The row for JSON: exact numbers with units in the keys, null for unknown."""
    return {**_json_values(row), "nodes": [_json_values(node) for node in row.nodes]}


def _json_values(row: DataflowRow | NodeRow) -> dict[str, Any]:
    return {_JSON_KEYS.get(key, key): value for key, value in row._asdict().items()}


_JSON_KEYS = {
    "uptime": "uptime_us",
    "started": "started_us",
    "since": "since_us",
    "ended": "ended_us",
    "memory": "memory_bytes",
    "memory_peak": "memory_peak_bytes",
    "memory_limit": "memory_limit_bytes",
    "cpu_limit": "cpu_limit_percent",
    "throttled": "throttled_percent",
}
