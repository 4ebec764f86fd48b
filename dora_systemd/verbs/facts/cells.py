"""Finds the dataflows of one systemd manager."""

from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import UP, Manager, UnitState
from dora_systemd.decisions.cell.options import RunnerOptions, options_from_command
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import UNIT_PREFIX, UNIT_SUFFIX, name_from_unit

_PATTERN = f"{UNIT_PREFIX}*{UNIT_SUFFIX}"


class Cell(NamedTuple):
    """One dataflow that systemd has loaded: the state of its unit, and its runner's options."""

    state: UnitState
    options: RunnerOptions

    @property
    def name(self) -> str:
        """The name of the dataflow."""
        return self.options.name

    @property
    def uuid(self) -> str:
        """The UUID of the dataflow, which restarts keep."""
        return self.options.uuid

    @property
    def unit(self) -> str:
        """The name of the unit."""
        return self.state.unit

    @property
    def is_up(self) -> bool:
        """Whether it runs, or is on its way up or down."""
        return self.state.active in UP


def read_cells(manager: Manager) -> list[Cell]:
    """All dataflows that systemd has loaded, by name, without foreign units of such names."""
    states = [one for one in manager.list_units(_PATTERN) if one.load == "loaded"]
    cells = (_cell(manager, state) for state in states if name_from_unit(state.unit))
    return sorted((cell for cell in cells if cell), key=lambda cell: cell.name)


def read_cell(manager: Manager, unit: str) -> Cell | None:
    """The dataflow of one unit, or None if it does not exist or is not ours."""
    state = manager.read(unit, ["LoadState", "ActiveState", "SubState"])
    if state["LoadState"] != "loaded":
        return None
    found = UnitState(unit, state["LoadState"], state["ActiveState"], state["SubState"])
    return _cell(manager, found)


def _cell(manager: Manager, state: UnitState) -> Cell | None:
    commands: Any = manager.read(state.unit, ["ExecStart"])["ExecStart"]
    try:
        options = options_from_command(commands[0][1])
    except (DoraSystemdError, IndexError):
        return None
    return Cell(state, options) if name_from_unit(state.unit) == options.name else None
