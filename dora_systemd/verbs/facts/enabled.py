"""Finds the dataflows that are started at boot. `list` uses it: imports only what loads quickly."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.names import name_from_unit
from dora_systemd.paths import unit_directories
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import exists


def enabled_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """The names of the units that are started at boot."""
    return wanted_units(own_directories(manager, scope)[0])


def enabled_names(manager: Manager, scope: Scope) -> list[str]:
    """The names of the dataflows that are started at boot, sorted."""
    return sorted(filter(None, map(name_from_unit, enabled_units(manager, scope))))


def wanted_units(directory: Path, target: str = "*") -> frozenset[str]:
    """The units that targets in `directory` start: the links in its .wants directories.

    target: only this one.
    """
    return frozenset(path.name for path in directory.glob(f"{target}.wants/dora-*.service"))


def lost_units(manager: Manager, scope: Scope) -> frozenset[str]:
    """Find the enabled units that systemd does not know, although their files exist.

    systemd caches the path of each unit's file. For a transient unit that is the fragment, and
    stays so when the unit has ended and the fragment is gone. Only a reload makes systemd search
    the enabled file (seen with systemd 257).
    """
    directory = own_directories(manager, scope)[0]
    unknown = (
        unit
        for unit in enabled_units(manager, scope)
        if manager.read(unit, ["LoadState"])["LoadState"] == "not-found"
    )
    return frozenset(unit for unit in unknown if exists(directory / unit))


def own_directories(manager: Manager, scope: Scope) -> tuple[Path, Path]:
    """The directory of the admin's (or user's) unit files, and the one that a reboot empties."""
    root = str(scope.runtime_root)
    lasting, fleeting = unit_directories(manager.unit_path(), scope.is_user, root)
    return Path(lasting), Path(fleeting)


def trial_path(scope: Scope, unit: str) -> Path:
    """The unit file of a trial, see verbs/releases/trial.py."""
    return scope.runtime_root / "systemd" / f"{scope.word}.control" / unit
