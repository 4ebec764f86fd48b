"""Counters of one cell: CPU time and the usage between two samples of it, and lines."""

from collections.abc import Mapping
from typing import NamedTuple

WHOLE_CELL = ""
"""The key of a CPU sample for the whole cgroup of the unit, and of lines that were lost."""
SAMPLES_KEPT = 2
SHORTEST_WINDOW_US = 1_000_000


class CpuSample(NamedTuple):
    """CPU time used until `at_us` (CLOCK_MONOTONIC µs), in µs, by node id.

    throttling: periods in which the node was runnable, and periods in which its limit throttled it.
    The key WHOLE_CELL is the unit's whole cgroup.
    """

    at_us: int
    cpu_us: Mapping[str, int] = {}
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
