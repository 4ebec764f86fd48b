"""Which dataflows a boot starts: for `list`, so it imports nothing that costs time."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import wanted_units
from dora_systemd.decisions.unit.directories import unit_directories
from dora_systemd.scope import Scope


def enabled_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """The names of the units that a boot starts."""
    return wanted_units(own_directories(manager, scope)[0])


def own_directories(manager: Manager, scope: Scope) -> tuple[Path, Path]:
    """Where the admin's (or the user's) unit files are, and those that a reboot ends."""
    root = str(scope.runtime_root)
    lasting, fleeting = unit_directories(manager.unit_path(), scope.is_user, root)
    return Path(lasting), Path(fleeting)
