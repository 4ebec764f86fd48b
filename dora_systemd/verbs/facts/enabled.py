"""Finds the dataflows that are started at boot. `list` uses it: imports only what loads quickly."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import wanted_units
from dora_systemd.decisions.unit.directories import unit_directories
from dora_systemd.scope import Scope


def enabled_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """The names of the units that are started at boot."""
    return wanted_units(own_directories(manager, scope)[0])


def own_directories(manager: Manager, scope: Scope) -> tuple[Path, Path]:
    """The directory of the admin's (or user's) unit files, and the one that a reboot empties."""
    root = str(scope.runtime_root)
    lasting, fleeting = unit_directories(manager.unit_path(), scope.is_user, root)
    return Path(lasting), Path(fleeting)
