"""Reads what all processes of this machine use."""

import os
from pathlib import Path

from dora_systemd.decisions.resources.host import Disk, HostUse, fullest, parse_memory, parse_ticks

PROC = Path("/proc")
DISKS = ("/", "/var")
"""Directories on the disks that have the journal, releases and bundles."""


def read_host(proc: Path = PROC, disks: tuple[str, ...] = DISKS) -> HostUse:
    """Read the usage of the machine; what cannot be read is None."""
    busy, ticks = parse_ticks(_text(proc / "stat"))
    memory, available = parse_memory(_text(proc / "meminfo"))
    disk = fullest([one for one in map(_disk, disks) if one])
    return HostUse(busy, ticks, os.cpu_count() or 1, memory, available, disk)


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def _disk(path: str) -> Disk | None:
    try:
        found = os.statvfs(path)
    except OSError:
        return None
    size = found.f_blocks * found.f_frsize
    return Disk(path, size, found.f_bavail * found.f_frsize) if size else None
