"""Finds the dataflows that are started at boot. `list` uses it: imports only what loads quickly."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import wanted_units
from dora_systemd.decisions.unit.directories import unit_directories
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import exists
from dora_systemd.verbs.facts.cells import Cell, find_cell


def enabled_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """The names of the units that are started at boot."""
    return wanted_units(own_directories(manager, scope)[0])


def lost_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """The enabled units that systemd does not know, although their files are there.

    systemd notes where the file of each unit name is. For a transient unit it notes the fragment,
    and keeps the note when the unit has ended and the fragment is gone. Only a reload makes it look
    for the enabled file (seen with systemd 257).
    """
    directory = own_directories(manager, scope)[0]
    unknown = (
        unit
        for unit in enabled_units(manager, scope)
        if manager.read(unit, ["LoadState"])["LoadState"] == "not-found"
    )
    return frozenset(unit for unit in unknown if exists(directory / unit))


def find_enabled_cell(manager: Manager, scope: Scope, selector: str) -> Cell:
    """As find_cell, also for an enabled dataflow that systemd has lost. Raises DoraSystemdError."""
    try:
        return find_cell(manager, selector)
    except DoraSystemdError as error:
        if error.code is not ExitCode.NOT_FOUND or not lost_units(manager, scope):
            raise
    manager.reload()
    return find_cell(manager, selector)


def own_directories(manager: Manager, scope: Scope) -> tuple[Path, Path]:
    """The directory of the admin's (or user's) unit files, and the one that a reboot empties."""
    root = str(scope.runtime_root)
    lasting, fleeting = unit_directories(manager.unit_path(), scope.is_user, root)
    return Path(lasting), Path(fleeting)
