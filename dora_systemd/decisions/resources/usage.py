"""Resource usage and waiting times of a cgroup. Pure."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd.values import INFINITY, SECOND

RESOURCES = ("cpu", "memory", "io")
WORTH_SHOWING = 1.0
"""Percent of the time from which on a wait is shown."""


class Usage(NamedTuple):
    """The usage of one group.

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
    """Counters of one group, which only increase, see the kernel's "Control Group v2" and "PSI".

    stalled: by resource, µs in which some of its processes waited for it, and µs in which all did;
    without resources that the kernel does not measure. throttled: µs of throttling by the CPU
    limit. oom_kills: number of OOM kills.
    """

    stalled: Mapping[str, tuple[int, int]] = {}
    throttled: int = 0
    oom_kills: int = 0


def limit_of(value: int | None) -> int | None:
    """A limit of Usage, None without one."""
    return None if value == INFINITY else value


def usage_facts(use: Usage, cpu_percent: float | None, throttled: float | None) -> dict[str, Any]:
    """The fields of a row. throttled: percentage of the time, for a group with a CPU limit."""
    share = limit_of(use.cpu_max)
    return {
        "cpu_percent": cpu_percent,
        "cpu_limit": None if share is None else 100 * share / SECOND,
        "throttled": None if share is None else throttled,
        "memory": use.memory,
        "memory_peak": use.memory_peak,
        "memory_limit": limit_of(use.memory_max),
    }


def waits(before: Strain, now: Strain, window: int) -> dict[str, float]:
    """By resource, the percentage of `window` µs in which some process waited for it."""
    if window <= 0:
        return {}
    return {
        resource: max(100.0 * (some - before.stalled.get(resource, (0, 0))[0]) / window, 0.0)
        for resource, (some, _) in now.stalled.items()
    }


def format_waits(shares: Mapping[str, float]) -> str:
    """The percentages worth showing, highest first, as in "memory 12% io 3%"."""
    worth = [(share, name) for name, share in shares.items() if share >= WORTH_SHOWING]
    return " ".join(f"{name} {share:.0f}%" for share, name in sorted(worth, reverse=True))
