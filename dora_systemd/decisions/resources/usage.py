"""What the processes of a group use, and what they had to wait for. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

RESOURCES = ("cpu", "memory", "io")
"""What systemd's properties say where cgroup files say "max", see systemd.resource-control(5)."""
WORTH_SHOWING = 1.0
"""Percent of the time from which on a wait is shown to people."""


class Usage(NamedTuple):
    """What one group uses. CPU in µs since the group was made, memory in bytes, None: not known.

    memory_max is INFINITY where there is no limit; cpu_max, in µs per second, too. throttling:
    periods in which the group wanted to run, and those in which it had to wait for its cpu.max.
    """

    cpu_us: int
    memory: int | None = None
    memory_peak: int | None = None
    memory_max: int | None = None
    cpu_max: int | None = None
    throttling: tuple[int, int] = (0, 0)


class Strain(NamedTuple):
    """Counters of one group, which only grow, see the kernel's "Control Group v2" and "PSI".

    stalled: by resource, the µs in which some of its processes waited for it, and those in which
    all did; a resource that the kernel does not watch is not there. throttled: µs for which the
    CPU limit held them. oom_kills: processes killed for want of memory.
    """

    stalled: Mapping[str, tuple[int, int]] = {}
    throttled: int = 0
    oom_kills: int = 0


def waits(before: Strain, now: Strain, window: int) -> dict[str, float]:
    """By resource, the percentage of `window` µs in which something waited for it."""
    if window <= 0:
        return {}
    return {
        resource: max(100.0 * (some - before.stalled.get(resource, (0, 0))[0]) / window, 0.0)
        for resource, (some, _) in now.stalled.items()
    }


def format_waits(shares: Mapping[str, float]) -> str:
    """Those that are worth a look, the longest first, as in "memory 12% io 3%"."""
    worth = [(share, name) for name, share in shares.items() if share >= WORTH_SHOWING]
    return " ".join(f"{name} {share:.0f}%" for share, name in sorted(worth, reverse=True))
