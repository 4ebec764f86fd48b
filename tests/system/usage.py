"""What the modules of tests take: time, and processor time of all that runs in the container."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STAT = Path("/sys/fs/cgroup/cpu.stat")
SHOWN = 12
"""So many modules, the longest ones."""


def processor_seconds(stat: Path = STAT) -> float:
    """Used so far in this cgroup; 0 where nobody counts it."""
    try:
        lines = stat.read_text().splitlines()
    except OSError:
        return 0.0
    found = dict(line.split() for line in lines)
    return int(found.get("usage_usec", 0)) / 1e6


class Usage:
    """By module: seconds, and seconds of the processor."""

    def __init__(self, stat: Path = STAT) -> None:
        self._stat = stat
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._processor: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def of(self, module: str) -> Iterator[None]:
        """Count what happens meanwhile to `module`."""
        begun, used = time.monotonic(), processor_seconds(self._stat)
        yield
        self._seconds[module] += time.monotonic() - begun
        self._processor[module] += processor_seconds(self._stat) - used

    def lines(self) -> list[str]:
        """A line for each of the longest modules, and one for all of them."""
        longest = sorted(self._seconds, key=lambda one: -self._seconds[one])[:SHOWN]
        rows = [(self._seconds[one], self._processor[one], one) for one in longest]
        rows.append((sum(self._seconds.values()), sum(self._processor.values()), "all modules"))
        return [
            f"{took:7.1f} s {used:7.1f} s of processor time  {name}" for took, used, name in rows
        ]
