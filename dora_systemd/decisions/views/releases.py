"""The table and the objects of `doractl releases`. Pure."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.decisions.releases.past import FAILED, ROLLED_BACK, UNPROVED, Switch
from dora_systemd.decisions.releases.program_versions import PROGRAMS
from dora_systemd.decisions.releases.progress import COPY, SOAK, Step
from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.decisions.views.formats import UNKNOWN, local_time
from dora_systemd.decisions.views.objects import moment
from dora_systemd.values import format_rounded_size

HEADER = ("NAME", "ID", "STATE", "CREATED", "SIZE", "FILES", "DORA", "PYTHON")
WHY = "WHY"
"""The column that only a table with bad releases has."""
_HISTORY = ("AT", "FROM", "TO", "ENDED", "BY", WHY)
_UNENDED = "its trial did not end"


class ReleaseRow(NamedTuple):
    """A release."""

    name: str
    id: str
    state: str
    tree: str  # the directory of its files
    manifest: Manifest | None  # None if it is not readable
    ran_us: int = 0  # when it began to run the last time
    end: Switch | None = None  # what made it bad, or its last end; None if there was none

    @property
    def why(self) -> str:
        """The reason why no rollback chooses the release by itself, or ""."""
        if self.state == UNPROVED:
            return self.end.reason if self.end else _UNENDED
        if self.state not in (FAILED, ROLLED_BACK) or not self.end:
            return ""
        return self.end.reason or f"by {self.end.by or UNKNOWN}"


def format_releases(
    rows: Sequence[ReleaseRow], width: int | None = None, want_colors: bool = False
) -> str:
    """The table, for a terminal of that width."""
    return format_cells(HEADER, list(map(_cells, rows)), width, want_colors)


def format_cells(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    width: int | None = None,
    want_colors: bool = False,
) -> str:
    """The table of these cells; the last one of each is for WHY, a column for bad releases."""
    if any(row[-1] not in ("", UNKNOWN) for row in rows):
        return format_table([*header, WHY], rows, width, want_colors)
    return format_table(header, [row[:-1] for row in rows], width, want_colors)


def format_history(
    history: Sequence[Switch], width: int | None = None, want_colors: bool = False
) -> str:
    """The table of what ran, for a terminal of that width."""
    rows = [
        (
            local_time(one.at_us),
            *(text or UNKNOWN for text in (one.former, one.release, one.how, one.by, one.reason)),
        )
        for one in history
    ]
    return format_table(_HISTORY, rows, width, want_colors)


def _cells(row: ReleaseRow) -> tuple[str, ...]:
    one = row.manifest
    size = format_rounded_size(one.size) if one else UNKNOWN
    count = str(len(one.files)) if one else UNKNOWN
    versions = [one.versions.get(name, UNKNOWN) if one else UNKNOWN for name in PROGRAMS]
    created = local_time(one.created_us if one else 0)
    return (row.name, row.id, row.state, created, size, count, *versions, row.why or UNKNOWN)


def release_object(row: ReleaseRow) -> dict[str, Any]:
    """A release for `-o json`."""
    one = row.manifest
    return {
        "name": row.name,
        "release": row.id,
        "state": row.state,
        "why": row.why or None,
        **moment("ran", row.ran_us),
        "ended": row.end.how if row.end else None,
        "ended_by": (row.end.by or None) if row.end else None,
        "tree": row.tree,
        "uuid": one.uuid if one else None,
        "revision": (one.revision or None) if one else None,
        "source": one.source if one else None,
        "user": (one.user or None) if one else None,
        **moment("created", one.created_us if one else 0),
        "size_bytes": one.size if one else None,
        "files": len(one.files) if one else None,
        "versions": dict(one.versions) if one else None,
    }


def step_object(one: Step) -> dict[str, Any]:
    """A step of a deploy or a rollback for `-o json`."""
    done, total = one.amount or (None, None)
    ready, nodes = one.nodes or (None, None)
    is_copy, is_soak = one.stage == COPY, one.stage == SOAK
    return {
        "stage": one.stage,
        "text": one.text,
        "done_bytes": done if is_copy else None,
        "total_bytes": total if is_copy else None,
        "nodes_ready": ready,
        "nodes_total": nodes,
        "soaked_us": done if is_soak else None,
        "soak_us": total if is_soak else None,
        "passed": one.passed,
    }
