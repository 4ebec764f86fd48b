"""Resource usage of a cgroup, CPU time between two samples of it, and counters of lines. Pure."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd.values import INFINITY, SECOND

RESOURCES = ("cpu", "memory", "io", "irq")
"""Those of the kernel's "PSI" document; irq is the time that interrupt handlers took from a group,
which kernels with CONFIG_IRQ_TIME_ACCOUNTING measure.
"""
WORTH_SHOWING = 1.0
"""Percent of the time from which on a wait is shown."""


class Usage(NamedTuple):
    """The usage of one group.

    memory_max is INFINITY where there is no limit; cpu_max, in µs per second, too.
    """

    cpu_us: int
    memory: int | None = None
    memory_peak: int | None = None
    memory_max: int | None = None
    cpu_max: int | None = None
    # periods in which the group wanted to run, and those in which it had to wait for its cpu.max
    throttling: tuple[int, int] = (0, 0)


class Strain(NamedTuple):
    """Counters of one group, which only increase, see the kernel's "Control Group v2" and "PSI"."""

    # by resource, µs in which some of its processes waited for it, and µs in which all did; without
    # resources that the kernel does not measure
    stalled: Mapping[str, tuple[int, int]] = {}
    throttled: int = 0  # µs of throttling by the CPU limit
    oom_kills: int = 0  # number of OOM kills


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
    """Return the percentage of `window` µs in which some process waited, by resource."""
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


WHOLE_CELL = ""
"""The key of a CPU sample for the whole cgroup of the unit, and of lines that were lost."""
SAMPLES_KEPT = 2
SHORTEST_WINDOW_US = 1_000_000


class CpuSample(NamedTuple):
    """CPU time until `at_us` (CLOCK_MONOTONIC), by node; WHOLE_CELL is the unit's cgroup. In µs."""

    at_us: int
    cpu_us: Mapping[str, int] = {}
    # periods in which the node was runnable, and periods in which its limit throttled it
    throttling: Mapping[str, tuple[int, int]] = {}


class LineCount(NamedTuple):
    """Numbers of lines written, suppressed by a limit, and lost, since the start."""

    written: int = 0
    suppressed: int = 0
    lost: int = 0


def add_sample(samples: tuple[CpuSample, ...], sample: CpuSample) -> tuple[CpuSample, ...]:
    """`samples` with a newer one added and the oldest dropped."""
    return (*samples, sample)[-SAMPLES_KEPT:]


def cpu_percent(samples: tuple[CpuSample, ...], now: CpuSample, key: str = WHOLE_CELL) -> float:
    """CPU usage of `key` up to `now` in percent of one processor, as top(1) counts.

    The window begins at the newest sample that is at least a second old. A key that a sample lacks
    had used nothing then; a smaller counter belongs to a new group.
    """
    base = _window_start(samples, now)
    window = now.at_us - base.at_us
    used = now.cpu_us.get(key, 0) - base.cpu_us.get(key, 0)
    return max(100.0 * used / window, 0.0) if window > 0 else 0.0


def throttled_percent(
    samples: tuple[CpuSample, ...], now: CpuSample, key: str = WHOLE_CELL
) -> float:
    """The percentage of time in which the CPU limit throttled `key`, of the time it was runnable.

    The window is that of cpu_percent.
    """
    old_periods, old_throttled = _window_start(samples, now).throttling.get(key, (0, 0))
    periods, throttled = now.throttling.get(key, (0, 0))
    wanted = periods - old_periods
    return 100.0 * (throttled - old_throttled) / wanted if wanted > 0 else 0.0


def _window_start(samples: tuple[CpuSample, ...], now: CpuSample) -> CpuSample:
    old_enough = [s for s in samples if now.at_us - s.at_us >= SHORTEST_WINDOW_US]
    return old_enough[-1] if old_enough else next(iter(samples), CpuSample(0))
