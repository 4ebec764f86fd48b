"""`doractl top`: takes snapshots of the dataflows, each compared with the one before it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.strain import read_strain
from dora_systemd.decisions.resources.usage import Strain, waits
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.decisions.views.top import Look, TopEntry
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells
from dora_systemd.verbs.facts.list import row_of
from dora_systemd.verbs.facts.reading import Reading, read_dataflow, slice_group
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.list import whole_rows, with_containers
from dora_systemd.verbs.node import require_running

_Seen = tuple[Reading, Mapping[str, Strain]]


class Top:
    """Takes snapshots of some dataflows of a manager, or of all running ones.

    Raises DoraSystemdError: NOT_FOUND for a selector without a match, USAGE for one with several,
    NOT_RUNNING for a dataflow that is not up.
    """

    def __init__(self, manager: Manager, scope: Scope, selectors: Sequence[str] = ()) -> None:
        self._manager = manager
        self._scope = scope
        self._before: dict[str, _Seen] = {}
        cells = read_cells(manager) if selectors else []
        self._units = frozenset(self._unit(Selector(one), cells) for one in selectors)

    def _unit(self, selector: Selector, cells: Sequence[Cell]) -> str:
        """The unit of the dataflow that is meant, which has to run. Raises DoraSystemdError."""
        with selector.telling_ended(self._scope):
            cell = selector.loaded(cells)
        require_running(cell)
        return cell.unit

    def look(self) -> Look:
        """A snapshot of what is running; rates are since the last snapshot."""
        cells = [cell for cell in read_cells(self._manager) if cell.is_up]
        wanted = proven(one for one in cells if not self._units or one.unit in self._units)
        readings = [read_dataflow(self._manager, self._scope, cell) for cell in wanted]
        seen = {one.cell.unit: (one, read_strains(one)) for one in readings}
        entries = [_entry(now, self._before.get(unit)) for unit, now in seen.items()]
        self._before = seen
        rows = whole_rows(self._manager, self._scope, readings, [one.row for one in entries])
        return Look(
            time.time_ns() // 1000,
            [replace(one, row=row) for one, row in zip(entries, rows, strict=True)],
        )


def _entry(now: _Seen, before: _Seen | None) -> TopEntry:
    reading, strains = now
    if before is None or not _is_same_run(before[0], reading):
        return TopEntry(row_of(reading))
    window = reading.at_us - before[0].at_us
    shares = {
        key: waits(before[1].get(key, Strain()), strain, window) for key, strain in strains.items()
    }
    return TopEntry(row_of(reading, before[0]), shares)


def _is_same_run(one: Reading, other: Reading) -> bool:
    key = "InactiveExitTimestampMonotonic"
    return bool(one.usage and other.usage) and one.unit[key] == other.unit[key]


def read_snapshot(manager: Manager, scope: Scope, is_whole: bool = False) -> list[Observed]:
    """Read all dataflows that systemd has loaded, including failed ones.

    is_whole: with all that `list` knows of them, and not only what a reading shows.
    """
    cells = proven(read_cells(manager))
    path = slice_group(manager) if cells else None
    readings = [read_dataflow(manager, scope, cell, path) for cell in cells]
    rows = list(map(row_of, readings))
    if is_whole:
        rows = whole_rows(manager, scope, readings, rows)
    else:
        rows = list(map(with_containers, readings, rows))
    return list(map(_observe, readings, rows))


def _observe(reading: Reading, row: DataflowRow) -> Observed:
    """Return what a reading shows of a dataflow, with its pressure stall information."""
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
