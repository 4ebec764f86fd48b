"""Where the cgroup tree has the dataflows of one manager; apart, because most verbs do without."""

from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.names import SLICE


def slice_group(manager: Manager) -> Path:
    """The directory of dora.slice, which has the units unless a property puts them elsewhere."""
    return cgroup.group_path(manager.control_group()) / SLICE
