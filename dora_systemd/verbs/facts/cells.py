"""Finds the dataflows of one systemd manager. `list` uses it: imports only what loads quickly."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.bus.manager import DOWN, UP, Manager, UnitState
from dora_systemd.decisions.views.dataflows import status_word
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import (
    UNIT_PREFIX,
    UNIT_SUFFIX,
    facts_from_description,
    name_from_unit,
    release_of,
)

if TYPE_CHECKING:
    from dora_systemd.decisions.cell.options import RunnerOptions

CONTROL = "control"
"""What is done to single nodes, or by the dora command: no verb has this name."""
_PATTERN = f"{UNIT_PREFIX}*{UNIT_SUFFIX}"


class Cell:
    """One dataflow that systemd has loaded: the state of its unit, and its runner's options.

    manager: reads the options at their first use. options: if they are known already.
    """

    def __init__(
        self, state: UnitState, uuid: str, manager: Manager, options: "RunnerOptions | None" = None
    ) -> None:
        self.state = state
        self.uuid = uuid
        """The UUID of the dataflow, which restarts keep."""
        self._manager: Manager | None = None if options else manager
        self._options = options
        self.options_problem = ""
        """What this version does not know of the options, which another version has written."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cell) and (self.state, self.uuid) == (other.state, other.uuid)

    def __hash__(self) -> int:
        return hash(self.uuid)

    @property
    def name(self) -> str:
        return self.unit.removeprefix(UNIT_PREFIX).removesuffix(UNIT_SUFFIX)

    @property
    def unit(self) -> str:
        return self.state.unit

    @property
    def is_up(self) -> bool:
        """Whether it runs, is on its way up or down, or waits for its start."""
        return self.has_begun or self.state.is_held

    @property
    def has_begun(self) -> bool:
        """Whether systemd has begun its start, so that there may be processes of it."""
        return self.state.active in UP

    @property
    def has_failed(self) -> bool:
        """Whether systemd keeps its unit because it has failed."""
        return self.state.active == "failed" and not self.state.is_held

    def word(self, stage: str = "") -> str:
        """Return the status of the dataflow in one word, as status_word(). stage: the runner's."""
        return status_word(self.state.active, self.state.sub, stage, self.state.is_held)

    @property
    def awaits_restart(self) -> bool:
        """Whether its runner has ended, and systemd waits before it starts the next one."""
        return self.state.sub.startswith("auto-restart")

    @property
    def options(self) -> "RunnerOptions":
        """The options in ExecStart= of the unit.

        Raises DoraSystemdError (NOT_FOUND) if it is not a dataflow of ours (any more).
        """
        if self._options is None and self._manager is not None:
            self._options, self.options_problem = _read_options(self._manager, self.unit)
            self._manager = None  # the gateway keeps cells, and must not keep their connections
        if self._options is None:
            message = f"cannot read {self.unit}: it has ended, or is no dataflow"
            raise DoraSystemdError(message, "see doractl list --all", ExitCode.NOT_FOUND)
        return self._options

    @property
    def release(self) -> str:
        """The release that it runs, "" if it was not deployed."""
        found = facts_from_description(self.unit, self.state.description)
        return found[1] if found else release_of(self.options.dataflow)

    @property
    def known_options(self) -> "RunnerOptions | None":
        """The options, if they have been read already."""
        return self._options

    @property
    def dataflow(self) -> str:
        """The path of the descriptor, or "" as long as the options have not been read."""
        return self._options.dataflow if self._options else ""

    @property
    def has_options(self) -> bool:
        """Whether the unit is ours by its ExecStart=; its Description= alone proves nothing."""
        try:
            return bool(self.options)
        except DoraSystemdError as error:
            if error.code is not ExitCode.NOT_FOUND:
                raise
            return False


def read_cells(manager: Manager) -> list[Cell]:
    """Read all dataflows that systemd has loaded, by name, without foreign units of such names.

    One question, if all have the Description= of this version.
    """
    states = [one for one in manager.list_units(_PATTERN) if one.load == "loaded"]
    cells = (_listed(manager, state) for state in states if name_from_unit(state.unit))
    return sorted((cell for cell in cells if cell), key=lambda cell: cell.name)


def proven(cells: Iterable[Cell]) -> list[Cell]:
    """Return the cells that are ours by their ExecStart=, with their options: one request each.

    Whatever acts on dataflows or needs their options begins with proven(): systemd discards the
    options with the unit.
    """
    return [cell for cell in cells if cell.has_options]


def read_cell(manager: Manager, unit: str) -> Cell | None:
    """The dataflow of one unit, or None if it does not exist or is not ours."""
    load = str(manager.read(unit, ["LoadState"])["LoadState"])
    return loaded_cell(manager, unit) if load == "loaded" else None


def loaded_cell(manager: Manager, unit: str) -> Cell | None:
    """The dataflow of a unit that systemd has loaded, or None if it is not ours."""
    state = manager.read(unit, ["ActiveState", "SubState"])
    found = UnitState(unit, "loaded", state["ActiveState"], state["SubState"])
    if found.active in DOWN:
        # Only the list has the types of jobs. It may have lost the unit, which it does not load.
        found = next(iter(manager.list_units(unit)), found)
    return _asked(manager, found)


def _listed(manager: Manager, state: UnitState) -> Cell | None:
    found = facts_from_description(state.unit, state.description)
    return Cell(state, found[0], manager) if found else _asked(manager, state)


def _asked(manager: Manager, state: UnitState) -> Cell | None:
    """Read the dataflow of a unit by its ExecStart=, as the owner may change Description=."""
    options, problem = _read_options(manager, state.unit)
    if options is None:
        return None
    cell = Cell(state, options.uuid, manager, options)
    cell.options_problem = problem
    return cell


def _read_options(manager: Manager, unit: str) -> "tuple[RunnerOptions | None, str]":
    # Imported late: the list of what runs has all it needs from systemd's own list.
    from dora_systemd.decisions.cell.options import known_options_from_command, options_from_command

    commands: Any = manager.read(unit, ["ExecStart"])["ExecStart"]
    problem = ""
    try:
        try:
            options = options_from_command(commands[0][1])
        except DoraSystemdError as error:
            options = known_options_from_command(commands[0][1])
            problem = error.message
    except (DoraSystemdError, IndexError):
        return None, ""
    return (options, problem) if name_from_unit(unit) == options.name else (None, "")


def restart_due(cell: Cell, problem: str) -> DoraSystemdError:
    """The error (NOT_RUNNING) for what needs a runner while systemd waits to start the next one."""
    hint = f"doractl restart {cell.name} starts it now"
    return DoraSystemdError(f"{problem}: it waits for its restart", hint, ExitCode.NOT_RUNNING)


def refuse_parts(cells: Iterable[Cell], verb: str) -> None:
    """Raise DoraSystemdError (FAILURE) for a part, which names the machine to go to."""
    for cell in cells:
        machine, head = cell.options.machine, cell.options.head
        if machine:
            message = (
                f"cannot {verb} {cell.name} here: this is its part on machine {machine}, "
                f"and the head is {head or 'another machine'}"
            )
            there = f"on {head}" if head else "on the head"
            hint = f"{there}: doractl {verb} {cell.name}"
            raise DoraSystemdError(message, f"use doractl {there}" if verb == CONTROL else hint)


def without_parts(cells: Iterable[Cell]) -> list[Cell]:
    """The dataflows of which this machine is not only a member."""
    return [cell for cell in cells if not cell.options.machine]
