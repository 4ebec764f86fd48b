"""Reads all dataflows of a manager at one moment, for top, metrics and the page."""

from collections.abc import Mapping

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.strain import read_strain
from dora_systemd.decisions.resources.usage import Strain
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import proven, read_cells
from dora_systemd.verbs.facts.list import row_of
from dora_systemd.verbs.facts.reading import Reading, read_dataflow, slice_group
from dora_systemd.verbs.facts.whole import whole_rows


def read_snapshot(manager: Manager, scope: Scope, is_whole: bool = False) -> list[Observed]:
    """All dataflows that systemd has loaded, including failed ones.

    is_whole: with all that `list` knows of them, and not only what a reading shows.
    """
    cells = proven(read_cells(manager))
    path = slice_group(manager) if cells else None
    readings = [read_dataflow(manager, scope, cell, path) for cell in cells]
    rows = list(map(row_of, readings))
    if is_whole:
        rows = whole_rows(manager, scope, readings, rows)
    return list(map(_observe, readings, rows))


def _observe(reading: Reading, row: DataflowRow) -> Observed:
    """What a reading shows of a dataflow, with its pressure stall information."""
    restarts = reading.unit["NRestarts"]
    return Observed(
        row,
        reading.at_us,
        restarts,
        {**reading.usage, **{node: one.use for node, one in reading.away.items()}},
        read_strains(reading),
        reading.status.lines,
    )


def read_strains(reading: Reading) -> Mapping[str, Strain]:
    """The pressure stall information of each group of a dataflow."""
    return {key: read_strain(path) for key, path in reading.groups.items()}
