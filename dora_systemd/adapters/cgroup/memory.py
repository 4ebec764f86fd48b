"""Reads memory counters of a cgroup: OOM kills, and how close the group is to its limit."""

import re
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import read_number, read_numbers, read_text
from dora_systemd.decisions.resources.oom import OomCounts
from dora_systemd.decisions.resources.pressure import Load
from dora_systemd.decisions.resources.usage import UNLIMITED


def read_oom(path: Path) -> OomCounts:
    """The number of OOM kills in a group, and of those that its own limit caused."""
    return OomCounts(
        read_numbers(path / "memory.events").get("oom_kill", 0),
        read_numbers(path / "memory.events.local").get("oom", 0),
    )


def read_load(path: Path) -> Load:
    """How close a group is to its memory limit; the caller adds the throttling.

    Only memory that the kernel cannot reclaim counts: file caches always grow up to the limit.
    """
    limits = [read_number(path / name) for name in ("memory.max", "memory.high")]
    limit = min((one for one in limits if one is not None), default=UNLIMITED)
    if limit == UNLIMITED:
        return Load()
    stat = read_numbers(path / "memory.stat")
    return Load(stat.get("anon", 0) + stat.get("shmem", 0), limit, _read_stalled(path))


def _read_stalled(path: Path) -> float:
    """avg10 of "some" in memory.pressure, see the kernel's "PSI" document; 0 without PSI."""
    match = re.search(r"^some avg10=([0-9.]+)", read_text(path / "memory.pressure"))
    return float(match[1]) if match else 0.0
