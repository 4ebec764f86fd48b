"""The table and the objects of `doractl bundles`. Pure."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.bundles.manifest import Manifest
from dora_systemd.decisions.views.dataflows import format_table
from dora_systemd.decisions.views.formats import UNKNOWN, local_time
from dora_systemd.decisions.views.objects import moment
from dora_systemd.values import format_rounded_size

HEADER = ("NAME", "BUNDLE", "WRITTEN", "EVENT", "SIZE", "WHY")


class BundleRow(NamedTuple):
    """A bundle in the store."""

    name: str  # of the dataflow
    id: str  # the name of its file
    file: str  # its path
    event: str  # what failed, or "requested"
    size: int
    manifest: Manifest | None  # None if it cannot be read


def format_bundles(
    rows: Sequence[BundleRow], width: int | None = None, want_colors: bool = False
) -> str:
    """The table, for a terminal of that width."""
    return format_table(HEADER, list(map(_cells, rows)), width, want_colors)


def _cells(row: BundleRow) -> tuple[str, ...]:
    size = format_rounded_size(row.size)
    if row.manifest is None:
        return (row.name, row.id, UNKNOWN, row.event, size, "it cannot be read")
    at = local_time(row.manifest.at_us)
    return (row.name, row.id, at, row.event, size, _why(row.manifest))


def _why(about: Manifest) -> str:
    """What has failed. If nothing has: the state of the dataflow, and who requested the bundle."""
    if about.cause or about.event:
        return about.summary or UNKNOWN
    by = f"requested by {about.by}" if about.by else ""
    return "; ".join(filter(None, (about.state, by))) or UNKNOWN


def bundle_object(row: BundleRow) -> dict[str, Any]:
    """The bundle for JSON."""
    known = row.manifest
    return {
        "name": row.name,
        "bundle": row.id,
        "file": row.file,
        "event": row.event,
        "size_bytes": row.size,
        **moment("at", known.at_us if known else 0),
        "uuid": known.uuid if known else None,
        "node": (known.node or None) if known else None,
        "cause": (known.cause or None) if known else None,
        "summary": (known.summary or None) if known else None,
        "state": (known.state or None) if known else None,
        "by": (known.by or None) if known else None,
        "left_out": list(known.left_out) if known else None,
    }
