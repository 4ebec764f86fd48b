"""The rows that `doractl list` shows, and their order, by the options of `dora list`."""

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase

from dora_systemd.decisions.views.dataflows import (
    DEGRADED,
    FAILED,
    FINISHED,
    FROZEN,
    RESTARTING,
    STARTING,
    STOPPED,
    STOPPING,
    UP_WORDS,
    WAITING,
)
from dora_systemd.decisions.views.rows import DataflowRow

STATUSES: Mapping[str, frozenset[str]] = {
    "running": UP_WORDS,
    "finished": frozenset({FINISHED, STOPPED}),
    "failed": frozenset({FAILED}),
    **{
        word.lower(): frozenset({word})
        for word in (STARTING, WAITING, DEGRADED, STOPPING, RESTARTING, FROZEN, STOPPED)
    },
}
"""The values of --status: dora's three, which leave out none, and other words of the table."""
SORTS = ("cpu", "memory", "restarts", "uptime", "name")
"""The values of --sort-by: dora's two, and other columns."""
_FIELDS = {"cpu": "cpu_percent"}


def is_of_the_past(status: str | None) -> bool:
    """Whether dataflows with that value of --status have ended."""
    return status is not None and not STATUSES[status] & UP_WORDS


def matching_rows(
    rows: Iterable[DataflowRow], status: str | None, pattern: str | None
) -> list[DataflowRow]:
    """The rows with that status, and with that name. None: all.

    pattern: a part of the name in any case, in which wildcards of glob(7) are possible.
    """
    part = f"*{(pattern or '').lower()}*"
    return [
        row
        for row in rows
        if (status is None or row.status in STATUSES[status])
        and fnmatchcase(row.name.lower(), part)
    ]


def sorted_rows(rows: Iterable[DataflowRow], by: str | None) -> list[DataflowRow]:
    """The rows by one of SORTS: the highest number first, or by name. None: as they are."""
    if by == "name":
        return sorted(rows, key=lambda row: row.name)
    field = _FIELDS.get(by or "", by)
    return sorted(rows, key=lambda row: -(getattr(row, field) or 0)) if field else list(rows)
