"""`doractl list`: what runs and what it uses, from systemd, the cgroups and the node table.

Nothing of ours has to be alive for it: the node table is only read.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dora_systemd import cgroup
from dora_systemd.busprotocol import Manager
from dora_systemd.cellpaths import CellPaths
from dora_systemd.errors import DoraSystemdError
from dora_systemd.managerbudget import restart_budget
from dora_systemd.managercells import Cell, matching_cells, read_cells, select_cell
from dora_systemd.managerenabled import enabled_units
from dora_systemd.scope import Scope
from dora_systemd.status import (
    WHOLE_CELL,
    CellStatus,
    CpuSample,
    NodeStatus,
    cpu_percent,
    throttled_percent,
)
from dora_systemd.statuswords import DataflowRow, NodeRow, status_word
from dora_systemd.usage import UNLIMITED, Usage
from dora_systemd.values import SECOND

_PROPERTIES = (
    "ControlGroup",
    "NRestarts",
    "ActiveEnterTimestampMonotonic",
    "InactiveExitTimestampMonotonic",
)
_DETAILS = ("StatusText", "ActiveEnterTimestamp")
_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class Reading:
    """One look at a dataflow: what systemd and its runner say, and what its groups have used.

    unit: properties of its unit. groups, usage: by node, WHOLE_CELL is the unit's own; empty for a
    dataflow that is not up. at_us: when, CLOCK_MONOTONIC.
    """

    cell: Cell
    unit: Mapping[str, Any]
    status: CellStatus = field(default_factory=CellStatus)
    groups: Mapping[str, Path] = field(default_factory=dict)
    usage: Mapping[str, Usage] = field(default_factory=dict)
    at_us: int = 0

    @property
    def sample(self) -> CpuSample:
        """What counts as CPU time and throttling of this look."""
        return CpuSample(
            self.at_us,
            {key: one.cpu_us for key, one in self.usage.items()},
            {key: one.throttling for key, one in self.usage.items()},
        )


def read_dataflow(manager: Manager, scope: Scope, cell: Cell, with_details: bool = True) -> Reading:
    """Look at one dataflow; at more than the table of `list` has only if asked."""
    unit = manager.read(cell.unit, (*_PROPERTIES, *(_DETAILS if with_details else ())))
    status = read_status(scope, cell) if cell.is_up else CellStatus()
    if not cell.is_up or not unit["ControlGroup"]:
        return Reading(cell, unit, status)
    path = cgroup.group_path(unit["ControlGroup"])
    # Without the runner's table the groups are all that is known of the nodes.
    nodes = cgroup.node_groups(path) if with_details or not status.nodes else {}
    groups = {WHOLE_CELL: path, **nodes}
    usage = {key: cgroup.read_usage(group) for key, group in groups.items()}
    return Reading(cell, unit, status, groups, usage, _monotonic_us())


def row_of(reading: Reading, before: Reading | None = None) -> DataflowRow:
    """All that `list` knows of one dataflow.

    before: an earlier look at the same run, where CPU and throttling begin; else the runner's own.
    """
    cell, unit, status = reading.cell, reading.unit, reading.status
    facts = {
        "uuid": cell.uuid,
        "name": cell.name,
        "unit": cell.unit,
        "status": status_word(cell.state.active, cell.state.sub, status.stage),
        "dataflow": cell.options.dataflow,
        "text": unit.get("StatusText", ""),
        "restarts": unit["NRestarts"] + status.node_restarts,
    }
    if not reading.usage:
        return DataflowRow(**facts)
    samples = (before.sample,) if before else status.samples
    return DataflowRow(**facts, **_life(unit), **_usage(reading, samples))


def dataflow_row(
    manager: Manager, scope: Scope, cell: Cell, with_details: bool = True
) -> DataflowRow:
    """The line of one dataflow."""
    return row_of(read_dataflow(manager, scope, cell, with_details))


def read_rows(manager: Manager, scope: Scope, with_details: bool = True) -> list[DataflowRow]:
    """All dataflows that systemd knows. with_details: for more than the table."""
    rows = [dataflow_row(manager, scope, cell, with_details) for cell in read_cells(manager)]
    return mark_enabled(manager, scope, rows) if rows else []


def mark_enabled(manager: Manager, scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The rows, with a mark on those that a boot starts."""
    enabled = enabled_units(manager, scope)
    return [replace(row, enabled=row.unit in enabled) for row in rows]


def find_row(manager: Manager, scope: Scope, selector: str) -> DataflowRow:
    """All that is known of the dataflow that `selector` means, ended ones in the journal too.

    Raises DoraSystemdError as select_cell does.
    """
    cells = read_cells(manager)
    if not matching_cells(cells, selector):
        from dora_systemd.managerended import select_ended

        row = select_ended(scope, selector)
        if row is not None:
            return row
    cell = select_cell(cells, selector)
    row = dataflow_row(manager, scope, cell)
    row = replace(row, restart_budget=restart_budget(manager, scope, cell))
    return mark_enabled(manager, scope, [row])[0]


def read_status(scope: Scope, cell: Cell) -> CellStatus:
    """The runner's node table; an empty one where it is missing or another user's."""
    try:
        text = CellPaths(scope.cell_directory(cell.name)).status.read_text()
        return CellStatus.from_json(text)
    except (OSError, UnicodeDecodeError, DoraSystemdError):
        return CellStatus()


def _life(unit: Mapping[str, Any]) -> dict[str, Any]:
    """Times of the present run; the monotonic ones do not care when the clock is set."""
    since = unit["ActiveEnterTimestampMonotonic"]
    if since < unit["InactiveExitTimestampMonotonic"]:
        return {"uptime": _monotonic_us() - unit["InactiveExitTimestampMonotonic"]}
    return {"uptime": _monotonic_us() - since, "started": unit.get("ActiveEnterTimestamp", 0)}


def _usage(reading: Reading, known: tuple[CpuSample, ...]) -> dict[str, Any]:
    status, use, now = reading.status, reading.usage, reading.sample
    samples = known or (CpuSample(reading.unit["InactiveExitTimestampMonotonic"]),)
    groups = {key: path for key, path in reading.groups.items() if key != WHOLE_CELL}
    names = status.nodes or dict.fromkeys(groups)
    return {
        **_numbers(use[WHOLE_CELL], samples, now, WHOLE_CELL),
        "nodes_total": len(names),
        "nodes_alive": status.alive_count if status.nodes else _populated(groups),
        "nodes": tuple(
            _node_row(
                node,
                status.nodes.get(node),
                _numbers(use[node], samples, now, node) if node in use else {},
            )
            for node in names
        ),
    }


def _numbers(
    use: Usage, samples: tuple[CpuSample, ...], now: CpuSample, key: str
) -> dict[str, Any]:
    """What a group uses and may use, as rows have it."""
    share = _limit(use.cpu_max)
    return {
        "cpu_percent": cpu_percent(samples, now, key),
        "cpu_limit": None if share is None else 100 * share / SECOND,
        "throttled": None if share is None else throttled_percent(samples, now, key),
        "memory": use.memory,
        "memory_peak": use.memory_peak,
        "memory_limit": _limit(use.memory_max),
    }


def _limit(value: int | None) -> int | None:
    return None if value == UNLIMITED else value


def _populated(groups: dict[str, Path]) -> int:
    return sum(map(cgroup.is_populated, groups.values()))


def _node_row(node: str, status: NodeStatus | None, numbers: dict[str, Any]) -> NodeRow:
    if status is None:
        return NodeRow(node, "unknown", **numbers)
    facts = {
        "pid": status.pid,
        "restarts": status.restarts,
        "max_restarts": status.max_restarts or None,
        "exit": status.exit,
        "since": status.since_us,
    }
    return NodeRow(node, status.state, **facts, **numbers)  # type: ignore[arg-type]


def _monotonic_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // _MICROSECOND_NS
