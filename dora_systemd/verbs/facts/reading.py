"""Reads one dataflow: systemd, its cgroups and the runner's node table.

It needs no running process of ours.
"""

import time
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dora_systemd.adapters.bus.manager import SETTLED, Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.resources.usage import WHOLE_CELL, CpuSample, Usage
from dora_systemd.decisions.views.dataflows import FROZEN
from dora_systemd.decisions.views.stages import stage_of_text
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import SLICE
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_table, read_times
from dora_systemd.verbs.facts.cells import Cell

if TYPE_CHECKING:  # the table of `list` does without
    from dora_systemd.decisions.cell.owes import Owed
    from dora_systemd.decisions.machines.usage import NodeUse
    from dora_systemd.verbs.facts.held import Held

UP_SINCE = "ActiveEnterTimestampMonotonic"
STARTED = "InactiveExitTimestampMonotonic"
ENDED = "InactiveEnterTimestamp"
PROCESS_STARTED = "ExecMainStartTimestamp"
_TEXT, _READY_AT = "StatusText", "ActiveEnterTimestamp"
_ALL = ("ControlGroup", "NRestarts", UP_SINCE, STARTED, _TEXT, _READY_AT, PROCESS_STARTED)

_NO_TABLE = CellStatus()
"""What a caller reads who may not read the table: systemd has its text."""


class Reading(NamedTuple):
    """One reading of a dataflow: its state from systemd and its runner, and usage of its groups."""

    cell: Cell
    unit: Mapping[str, Any]  # properties of its unit; NRestarts without a restart that was refused
    status: CellStatus = CellStatus()
    problem: str = ""  # why its node table is not usable, or ""
    # groups, usage: by node, with the unit's own as WHOLE_CELL; empty for a dataflow that is not
    # running
    groups: Mapping[str, Path] = {}
    usage: Mapping[str, Usage] = {}
    at_us: int = 0  # time of the reading, CLOCK_MONOTONIC
    # the last message of each owed output, on the same clock, 0 is never
    heard: tuple[int, ...] = ()
    held: "Held | None" = None  # what systemd waits for before it starts the dataflow
    is_frozen: bool = False  # whether the unit is frozen, see `systemctl freeze`
    is_row: bool = False  # whether it has only what the table of `list` shows

    @property
    def word(self) -> str:
        """The status of the dataflow in one word."""
        return FROZEN if self.is_frozen else self.cell.word(self.status.stage)

    @property
    def sample(self) -> CpuSample:
        """The CPU time and throttling of this reading."""
        return CpuSample(
            self.at_us,
            {key: one.cpu_us for key, one in self.usage.items()},
            {key: one.throttling for key, one in self.usage.items()},
        )

    @property
    def away(self) -> "Mapping[str, NodeUse]":
        """The usage of nodes on other machines, as members report it."""
        if not self.status.usage:
            return {}
        from dora_systemd.decisions.machines.usage import uses_of

        return uses_of(self.status)


def read_dataflow(
    manager: Manager, scope: Scope, cell: Cell, slice_path: Path | None = None, is_row: bool = False
) -> Reading:
    """Read one dataflow.

    slice_path: where the groups of dataflows usually are, for a reader of all dataflows. Then
    properties that the live table contains are not read from systemd. is_row: only what the table
    of `list` shows.
    """
    if cell.state.is_held:
        return _read_held(manager, cell)
    status, problem = look_at_table(scope, cell) if cell.is_up else (CellStatus(), "")
    path = slice_path / cell.unit if slice_path else None
    path = path if path and cgroup.has_group(path) else None
    if slice_path:
        known = _known(cell, status, is_row)
        unit = known | manager.read(cell.unit, _missing(cell, status, path, known, is_row))
    else:
        unit = manager.read(cell.unit, _ALL if cell.is_up else (*_ALL, ENDED))
    if unit["NRestarts"]:
        # Imported late: most dataflows have never been restarted.
        from dora_systemd.verbs.facts.budget import without_refused

        unit["NRestarts"] = without_refused(manager, cell, unit["NRestarts"])
    if cell.is_up and status == _NO_TABLE:
        status = status._replace(stage=stage_of_text(unit.get(_TEXT, "")))
    if not cell.is_up or not (path or unit["ControlGroup"]):
        return Reading(cell, unit, status, problem)
    path = path or cgroup.group_path(unit["ControlGroup"])
    # Without a node table the groups are all that is known of the nodes, and the dataflow's user
    # can create groups too. With a table, the groups of its nodes are enough.
    nodes = {} if is_row and status.nodes else cgroup.shown_groups(path, status.nodes)
    groups = {WHOLE_CELL: path, **nodes}
    read_group = cgroup.read_present if is_row else cgroup.read_usage
    usage = {key: read_group(group) for key, group in groups.items()}
    heard = () if is_row else _heard(scope, cell)
    read = Reading(cell, unit, status, problem, groups, usage, _monotonic_us(), heard)
    return read._replace(is_frozen=cgroup.is_frozen(path), is_row=is_row)


def _heard(scope: Scope, cell: Cell) -> tuple[int, ...]:
    if not cell.options.has("owes"):
        return ()
    # Imported late: few dataflows owe anything.
    from dora_systemd.decisions.cell.owes import owes_of

    return read_heard(scope, cell.name, owes_of(cell.options))


def _read_held(manager: Manager, cell: Cell) -> Reading:
    # Imported late: few dataflows need anything, and those that run have it.
    from dora_systemd.verbs.facts.budget import read_restarts
    from dora_systemd.verbs.facts.held import read_held

    unit = {"NRestarts": read_restarts(manager, cell)}
    return Reading(cell, unit, at_us=_monotonic_us(), held=read_held(manager, cell))


def read_heard(scope: Scope, name: str, owes: "Sequence[Owed]") -> tuple[int, ...]:
    """The last message of each owed output of a dataflow, CLOCK_MONOTONIC µs, 0 is never."""
    if not owes:
        return ()
    from dora_systemd.decisions.owes.probe import MOST_FEEDS, parse_times, size_of_times

    data = read_times(scope.cell_directory(name), size_of_times(len(owes) + MOST_FEEDS))
    return parse_times(data, len(owes), _monotonic_us())[1]


def _known(cell: Cell, status: CellStatus, is_row: bool) -> dict[str, Any]:
    """Return the properties that the live table contains, and that are not read from systemd.

    The dataflow's user can forge the table, but only that of the user's own dataflows.
    """
    known: dict[str, Any] = {}
    if cell.state.active in SETTLED:
        if status.is_first:
            known["NRestarts"] = 0  # the next restart begins another life, with another table
        if 0 < status.up_us <= _monotonic_us():
            known[UP_SINCE] = status.up_us
        if status.text and not is_row:
            known[_TEXT] = status.text
    return known


def _missing(
    cell: Cell, status: CellStatus, path: Path | None, known: Container[str], is_row: bool
) -> list[str]:
    """The properties that a reading still needs: each one is a question to systemd."""
    more = () if is_row else (_TEXT, _READY_AT)
    if not cell.is_up:
        return ["NRestarts", ENDED, *more]
    names = ["NRestarts", UP_SINCE] if path else ["NRestarts", UP_SINCE, "ControlGroup"]
    # Not needed for a running unit whose runner has samples, which are younger.
    names += [] if cell.state.active in SETTLED and status.samples else [STARTED]
    names += [_TEXT] if is_row and status == _NO_TABLE else []
    return [name for name in (*names, *more) if name not in known]


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


def _monotonic_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000


def slice_group(manager: Manager) -> Path:
    """The directory of dora.slice, which has the units unless a property puts them elsewhere."""
    return cgroup.group_path(manager.control_group()) / SLICE
