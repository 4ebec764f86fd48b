"""Finds the dataflows of one systemd manager, and those that a selector names."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import UP, Manager, UnitState
from dora_systemd.decisions.cell.options import RunnerOptions, options_from_command
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import (
    UNIT_PREFIX,
    UNIT_SUFFIX,
    is_uuid_prefix,
    name_from_unit,
    parse_name,
    unit_name,
)
from dora_systemd.values import quoted

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


def find_cell(manager: Manager, selector: str) -> Cell:
    """As select_cell, but also finds a dataflow whose unit file systemd has not loaded."""
    cells = read_cells(manager)
    if not matching_cells(cells, selector):
        unit = _named_unit(selector)
        cell = read_cell(manager, unit) if unit else None
        if cell is not None:
            return cell
    return select_cell(cells, selector)


def select_cell(cells: Sequence[Cell], selector: str) -> Cell:
    """The one dataflow that `selector` means: name, unit, UUID, or beginning of a UUID.

    Raises DoraSystemdError: NOT_FOUND with the nearest names, USAGE if several match.
    """
    found = matching_cells(cells, selector)
    if len(found) > 1:
        candidates = ", ".join(f"{cell.uuid} ({cell.name})" for cell in found)
        raise DoraSystemdError(
            f"cannot tell which dataflow {quoted(selector)} is",
            f"one of {candidates}",
            ExitCode.USAGE,
        )
    if not found:
        raise not_found(selector, [cell.name for cell in cells])
    return found[0]


def matching_cells(cells: Sequence[Cell], selector: str) -> list[Cell]:
    """The dataflows that match `selector`; a name or a unit takes precedence over UUIDs."""
    named = [cell for cell in cells if selector in (cell.name, cell.unit)]
    if named or not is_uuid_prefix(selector):
        return named
    return [cell for cell in cells if cell.uuid.startswith(selector.lower())]


def not_found(selector: str, names: Sequence[str]) -> DoraSystemdError:
    """The error for a selector without a match, with the nearest of `names` as hint."""
    from difflib import get_close_matches

    near = get_close_matches(selector, names, n=3, cutoff=0.5)
    if near:
        hint = f"did you mean {' or '.join(near)}?"
    elif names:
        hint = f"known dataflows: {', '.join(sorted(names)[:10])}"
    else:
        hint = "nothing is running; ended ones: doractl list --all"
    message = f"no dataflow named {quoted(selector)}"
    return DoraSystemdError(message, hint, ExitCode.NOT_FOUND)


def _named_unit(selector: str) -> str:
    """The unit that `selector` would name, "" if it is not a valid name."""
    try:
        return selector if name_from_unit(selector) else unit_name(parse_name(selector))
    except DoraSystemdError:
        return ""


def _cell(manager: Manager, state: UnitState) -> Cell | None:
    commands: Any = manager.read(state.unit, ["ExecStart"])["ExecStart"]
    try:
        options = options_from_command(commands[0][1])
    except (DoraSystemdError, IndexError):
        return None
    return Cell(state, options) if name_from_unit(state.unit) == options.name else None
