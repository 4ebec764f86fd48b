"""What a group had to wait for, and how its memory does, read from its control files."""

import re
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import read_number, read_numbers, read_text
from dora_systemd.decisions.resources.oom import OomCounts
from dora_systemd.decisions.resources.pressure import Load
from dora_systemd.decisions.resources.usage import RESOURCES, Strain
from dora_systemd.values import INFINITY

_PRESSURE = r"(?m)^(some|full) avg10=([0-9.]+)(?: avg60=([0-9.]+))?.* total=(\d+)$"


def read_strain(path: Path) -> Strain:
    """The counters of a group and all groups below it; zeros if it no longer exists."""
    stalls = {name: _read_stalls(f"{path}/{name}.pressure") for name in RESOURCES}
    return Strain(
        stalled={name: stall for name, stall in stalls.items() if stall is not None},
        throttled=read_numbers(f"{path}/cpu.stat").get("throttled_usec", 0),
        oom_kills=read_oom(path).kills,
    )


def read_oom(path: Path) -> OomCounts:
    """Count the kernel's OOM kills in a group, and those because of the group's own limit."""
    return OomCounts(
        read_numbers(f"{path}/memory.events").get("oom_kill", 0),
        read_numbers(f"{path}/memory.events.local").get("oom", 0),
    )


def read_load(path: Path) -> Load:
    """Read how much memory a group holds, and how close it is to its limit.

    The caller adds what concerns its CPU. Only memory counts that the kernel cannot drop: caches of
    files fill every group up. Files that processes have mapped are in addition: without these
    pages programs read them again and again.
    """
    stat = read_numbers(path / "memory.stat")
    held = stat.get("anon", 0) + stat.get("shmem", 0)
    limits = [read_number(path / name) for name in ("memory.max", "memory.high")]
    limit = min((one for one in limits if one is not None), default=INFINITY)
    # Pages of shmem count as mapped, and as those of files, too.
    files = stat.get("file", 0) - stat.get("shmem", 0)
    mapped = max(min(stat.get("file_mapped", 0), files), 0)
    if limit == INFINITY:
        return Load(held, mapped=mapped)
    return Load(held, limit, _read_stalled(path), mapped=mapped)


def read_waited(path: Path) -> float | None:
    """Percent of the last minute in which some process of a group waited for a CPU.

    This includes throttling by a CPU limit. None if the kernel does not measure it.
    """
    match = re.search(_PRESSURE, read_text(path / "cpu.pressure"))
    return float(match[3]) if match and match[3] else None


def _read_stalls(path: str) -> tuple[int, int] | None:
    """Read both totals of a pressure file in µs; None if the kernel does not measure them."""
    totals = {kind: int(total) for kind, *_, total in re.findall(_PRESSURE, read_text(path))}
    if not totals:
        return None
    # Interrupt handlers stop whole CPUs: irq.pressure has no "some".
    return totals.get("some", totals.get("full", 0)), totals.get("full", 0)


def _read_stalled(path: Path) -> float:
    """avg10 of "some" in memory.pressure, see the kernel's "PSI" document; 0 where it is off."""
    match = re.search(_PRESSURE, read_text(path / "memory.pressure"))
    return float(match[2]) if match else 0.0
