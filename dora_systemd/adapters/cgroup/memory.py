"""What the cgroup tree says of a group's memory: processes killed for want of it, and how close."""

import re
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import read_number, read_numbers, read_text
from dora_systemd.decisions.resources.oom import OomCounts
from dora_systemd.decisions.resources.pressure import Load
from dora_systemd.values import INFINITY


def read_oom(path: Path) -> OomCounts:
    """How often the kernel has killed in a group, and how often its own limit was the reason."""
    return OomCounts(
        read_numbers(path / "memory.events").get("oom_kill", 0),
        read_numbers(path / "memory.events.local").get("oom", 0),
    )


def read_load(path: Path) -> Load:
    """How close a group is to its limit of memory; its throttling is for the caller to say.

    What counts is what the kernel cannot drop: it fills every group up with files it has read.
    """
    limits = [read_number(path / name) for name in ("memory.max", "memory.high")]
    limit = min((one for one in limits if one is not None), default=INFINITY)
    if limit == INFINITY:
        return Load()
    stat = read_numbers(path / "memory.stat")
    return Load(stat.get("anon", 0) + stat.get("shmem", 0), limit, _read_stalled(path))


def _read_stalled(path: Path) -> float:
    """avg10 of "some" in memory.pressure, see the kernel's "PSI" document; 0 where it is off."""
    match = re.search(r"^some avg10=([0-9.]+)", read_text(path / "memory.pressure"))
    return float(match[1]) if match else 0.0
