"""`doractl list`: dataflows and their resource usage, from systemd, cgroups and node tables.

It needs no running process of ours: it only reads the node tables.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.status import (
    WHOLE_CELL,
    CellStatus,
    CpuSample,
    NodeStatus,
    cpu_percent,
    throttled_percent,
)
from dora_systemd.decisions.resources.usage import Usage
from dora_systemd.decisions.views.dataflows import DataflowRow, NodeRow, status_word
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.cells import read_table
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.slice import slice_group

_UP_SINCE = "ActiveEnterTimestampMonotonic"
_STARTED = "InactiveExitTimestampMonotonic"
_ALL = ("ControlGroup", "NRestarts", _UP_SINCE, _STARTED, "StatusText", "ActiveEnterTimestamp")
_MICROSECOND_NS = 1000


class Reading(NamedTuple):
    """One reading of a dataflow: its state from systemd and its runner, and usage of its groups.

    unit: properties of its unit. problem: why its node table is not usable, or "". groups, usage:
    by node, with the unit's own as WHOLE_CELL; empty for a dataflow that is not running. at_us:
    time of the reading, CLOCK_MONOTONIC.
    """

    cell: Cell
    unit: Mapping[str, Any]
    status: CellStatus = CellStatus()
    problem: str = ""
    groups: Mapping[str, Path] = {}
    usage: Mapping[str, Usage] = {}
    at_us: int = 0

    @property
    def sample(self) -> CpuSample:
        """The CPU time and throttling of this reading."""
        return CpuSample(
            self.at_us,
            {key: one.cpu_us for key, one in self.usage.items()},
            {key: one.throttling for key, one in self.usage.items()},
        )


def read_dataflow(
    manager: Manager, scope: Scope, cell: Cell, slice_path: Path | None = None
) -> Reading:
    """Read one dataflow.

    slice_path: where the groups of dataflows usually are; given if only the table of `list` is
    wanted.
    """
    status, problem = look_at_table(scope, cell) if cell.is_up else (CellStatus(), "")
    path = slice_path / cell.unit if slice_path else None
    path = path if path and path.is_dir() else None
    unit = manager.read(cell.unit, _few(cell, status, path) if slice_path else _ALL)
    if not cell.is_up or not (path or unit["ControlGroup"]):
        return Reading(cell, unit, status, problem)
    path = path or cgroup.group_path(unit["ControlGroup"])
    # Without a node table the groups are all that is known of the nodes, and the dataflow's user
    # can create groups too. With a table, the groups of its nodes are enough.
    nodes = cgroup.shown_groups(path, status.nodes) if not slice_path or not status.nodes else {}
    groups = {WHOLE_CELL: path, **nodes}
    usage = {key: cgroup.read_usage(group) for key, group in groups.items()}
    return Reading(cell, unit, status, problem, groups, usage, _monotonic_us())


def _few(cell: Cell, status: CellStatus, path: Path | None) -> list[str]:
    """The properties that a row of the table needs: reading each one costs as much as a file."""
    names = ["NRestarts"]
    if cell.is_up:
        names += [_UP_SINCE] if path else [_UP_SINCE, "ControlGroup"]
        # Not needed for a running unit whose runner has samples, which are younger.
        names += [] if cell.state.active == "active" and status.samples else [_STARTED]
    return names


def row_of(reading: Reading, before: Reading | None = None) -> DataflowRow:
    """All that `list` knows of one dataflow.

    before: an earlier reading of the same run, the base for CPU and throttling; without it, the
    samples of the runner.
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
        "problem": reading.problem,
    }
    if not reading.usage:
        return DataflowRow(**facts)
    samples = (before.sample,) if before else status.samples
    return DataflowRow(**facts, **_life(unit), **_usage(reading, samples))


def dataflow_row(manager: Manager, scope: Scope, cell: Cell) -> DataflowRow:
    """The row of one dataflow."""
    return row_of(read_dataflow(manager, scope, cell))


def read_rows(manager: Manager, scope: Scope, with_details: bool = True) -> list[DataflowRow]:
    """All dataflows that systemd has loaded. with_details: for more than the table."""
    cells = read_cells(manager)
    slice_path = None if with_details or not cells else slice_group(manager)
    rows = [row_of(read_dataflow(manager, scope, cell, slice_path)) for cell in cells]
    return mark_enabled(manager, scope, rows) if rows else []


def mark_enabled(manager: Manager, scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """The rows, with a mark on those that are started at boot."""
    enabled = enabled_units(manager, scope)
    return [row._replace(enabled=row.unit in enabled) for row in rows]


def read_status(scope: Scope, cell: Cell) -> CellStatus:
    """The runner's node table; an empty one if it is missing or not usable."""
    return look_at_table(scope, cell)[0]


def look_at_table(scope: Scope, cell: Cell) -> tuple[CellStatus, str]:
    """The runner's node table, and what is wrong with it, or "".

    A table that is invalid, missing or another user's counts as empty: the nodes' user can break
    only the own row, not the list.
    """
    try:
        return read_table(scope.cell_directory(cell.name)) or CellStatus(), ""
    except DoraSystemdError as error:
        return CellStatus(), error.message


def _life(unit: Mapping[str, Any]) -> dict[str, Any]:
    """Times of the current run; the monotonic ones do not depend on the setting of the clock."""
    since, started = unit[_UP_SINCE], unit.get(_STARTED, 0)
    if since < started:
        return {"uptime": _monotonic_us() - started}
    return {"uptime": _monotonic_us() - since, "started": unit.get("ActiveEnterTimestamp", 0)}


def _usage(reading: Reading, known: tuple[CpuSample, ...]) -> dict[str, Any]:
    status, use, now = reading.status, reading.usage, reading.sample
    samples = known or (CpuSample(reading.unit[_STARTED]),)
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
    """Usage and limits of a group, as rows have them."""
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
    return None if value == INFINITY else value


def _populated(groups: dict[str, Path]) -> int:
    return sum(map(cgroup.is_populated, groups.values()))


def _node_row(node: str, status: NodeStatus | None, numbers: dict[str, Any]) -> NodeRow:
    if status is None:
        return NodeRow(node, "unknown", **numbers)
    facts = {
        "pid": status.pid,
        "restarts": status.restarts,
        "max_restarts": status.max_restarts or None,
        "exit": str(status.exit),
        "since": status.since_us,
    }
    return NodeRow(node, status.state, **facts, **numbers)  # type: ignore[arg-type]


def _monotonic_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // _MICROSECOND_NS
