"""Reads the pressure stall information (PSI) of a cgroup."""

import re
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import read_numbers, read_text
from dora_systemd.adapters.cgroup.memory import read_oom
from dora_systemd.decisions.resources.usage import RESOURCES, Strain

_TOTAL = re.compile(r"^(some|full) .*total=(\d+)$", re.M)


def read_strain(path: Path) -> Strain:
    """The counters of a group and all groups below it; zeros if it no longer exists."""
    stalls = {name: _read_stalls(path / f"{name}.pressure") for name in RESOURCES}
    return Strain(
        stalled={name: stall for name, stall in stalls.items() if stall is not None},
        throttled=read_numbers(path / "cpu.stat").get("throttled_usec", 0),
        oom_kills=read_oom(path).kills,
    )


def _read_stalls(path: Path) -> tuple[int, int] | None:
    """Both totals of a pressure file in µs; None if the kernel does not measure them."""
    totals = {kind: int(total) for kind, total in _TOTAL.findall(read_text(path))}
    return (totals["some"], totals.get("full", 0)) if "some" in totals else None
