"""The tables of `doractl list` and `releases` of several hosts. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.releases.program_versions import PROGRAMS
from dora_systemd.decisions.views.dataflows import UNREACHABLE, dataflow_table, format_table
from dora_systemd.decisions.views.formats import UNKNOWN, local_time
from dora_systemd.decisions.views.releases import HEADER as RELEASES
from dora_systemd.decisions.views.releases import WHY, format_cells
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.selection import sorted_rows
from dora_systemd.values import as_mapping, format_rounded_size

_TEXTS = ("uuid", "name", "unit", "status", "text", "problem")
_NUMBERS = {
    "uptime": "uptime_us",
    "ended": "ended_us",
    "nodes_alive": "nodes_alive",
    "nodes_total": "nodes_total",
    "cpu_percent": "cpu_percent",
    "cpu_limit": "cpu_limit_percent",
    "memory": "memory_bytes",
    "memory_limit": "memory_limit_bytes",
    "restarts": "restarts",
}
_ZERO = {"ended": 0, "nodes_alive": 0, "nodes_total": 0}
_MOST = 1 << 62
"""No number of a host is larger: it could not be written as a time."""


def row_of(value: Mapping[str, Any]) -> DataflowRow | None:
    """The row of an object of `list -o json`; None if it has not the types of one."""
    texts: dict[str, Any] = {key: value.get(key) or "" for key in _TEXTS}
    if not all(isinstance(one, str) for one in texts.values()) or not texts["uuid"]:
        return None
    numbers: dict[str, Any] = {key: value.get(name) for key, name in _NUMBERS.items()}
    if not all(one is None or _is_number(one) for one in numbers.values()):
        return None
    numbers |= {key: zero for key, zero in _ZERO.items() if numbers[key] is None}
    return DataflowRow(**texts, **numbers, enabled=value.get("enabled") is True)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < _MOST


def format_hosts(
    found: Mapping[str, Sequence[DataflowRow] | None],
    width: int | None = None,
    want_colors: bool = False,
    sort_by: str | None = None,
) -> str:
    """The table, "" without a row. found: by host its rows, None for a host without an answer.

    sort_by: see sorted_rows(); without it the rows of a host stand together.
    """
    hosts = {id(row): host for host, rows in found.items() for row in rows or ()}
    rows = sorted_rows([row for some in found.values() for row in some or ()], sort_by)
    header, cells = dataflow_table(rows)
    lines = [[hosts[id(row)], *line] for row, line in zip(rows, cells, strict=True)]
    header = ["HOST", *header]
    lines += [_dead(host, header) for host, some in found.items() if some is None]
    return format_table(header, lines, width, want_colors) if lines else ""


def cells_of(value: Mapping[str, Any]) -> list[str] | None:
    """The cells of an object of `releases -o json`; None if it has not the types of one."""
    texts = [value.get(key) for key in ("name", "release", "state")]
    known = [value.get(key) for key in ("created_us", "size_bytes", "files")]
    if not all(isinstance(one, str) for one in texts):
        return None
    if not all(one is None or _is_number(one) for one in known):
        return None
    created, size, files = known
    versions = as_mapping(value.get("versions"))
    numbers = [
        local_time(int(created or 0)),
        UNKNOWN if size is None else format_rounded_size(int(size)),
        UNKNOWN if files is None else str(files),
    ]
    programs = (versions.get(one) for one in PROGRAMS)
    shown = (one if isinstance(one, str) else UNKNOWN for one in programs)
    why = value.get("why")
    return [*map(str, texts), *numbers, *shown, why if isinstance(why, str) else UNKNOWN]


def format_releases(
    found: Mapping[str, Sequence[Sequence[str]] | None],
    width: int | None = None,
    want_colors: bool = False,
) -> str:
    """The table of releases, "" without one. found: as of format_hosts(), the cells of rows."""
    header = ["HOST", *RELEASES]
    lines = [[host, *cells] for host, some in found.items() for cells in some or ()]
    dead = [_dead(host, [*header, WHY], "STATE") for host, some in found.items() if some is None]
    return format_cells(header, lines + dead, width, want_colors) if lines or dead else ""


def _dead(host: str, header: Sequence[str], column: str = "STATUS") -> list[str]:
    known = {"HOST": host, column: UNREACHABLE}
    return [known.get(title, UNKNOWN) for title in header]
