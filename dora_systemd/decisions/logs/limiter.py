"""Counts the lines that a node writes, for its limit. Pure: no clock."""

from dataclasses import dataclass, field

from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.values import SECOND


@dataclass
class _Window:
    end: float
    left: int


@dataclass
class LineLimiter:
    """Counts the lines of one node.

    Each stream has its own window, so that a flood on standard output does not suppress a traceback
    on standard error. A window begins with the first line after the last window. suppressed: number
    of refused lines since take_suppressed().
    """

    limit: RateLimit
    suppressed: int = 0
    _windows: dict[str, _Window] = field(default_factory=dict)

    def admit(self, stream: str, count: int, now: float) -> int:
        """How many of the `count` lines that have arrived at `now` (seconds) may pass."""
        window = self._windows.get(stream)
        if window is None or now >= window.end:
            window = _Window(now + self.limit.interval / SECOND, self.limit.lines)
            self._windows[stream] = window
        passed = min(count, window.left)
        window.left -= passed
        self.suppressed += count - passed
        return passed

    def end(self, stream: str) -> float:
        """The end of the current window of a stream, in seconds."""
        return self._windows[stream].end

    def take_suppressed(self) -> int:
        """Number of refused lines since the last call."""
        count, self.suppressed = self.suppressed, 0
        return count
