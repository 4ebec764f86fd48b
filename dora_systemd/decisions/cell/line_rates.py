"""Rate limits for log lines of nodes, and the counting of the lines. Pure: no clock.

The default is no limit, because a limit drops lines, even though it counts them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dora_systemd.decisions.cell.options import RunnerOptions, SettingText
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import check_known
from dora_systemd.values import INFINITY, SECOND, format_duration, parse_duration, quoted

SHORTEST = SECOND // 10
"""µs. A window with dropped lines ends with an event: at most ten per second."""

HINT = "write LINES/TIME such as 1000/1s, with at least one line and 100ms; or infinity"

ALL_NODES = ""


class RateLimit(NamedTuple):
    """`lines` of each of a node's streams in `interval` µs."""

    lines: int
    interval: int


RateLimits = Mapping[str, RateLimit | None]
"""Limits by node, with ALL_NODES for the others; None: no limit."""

UNLIMITED: RateLimits = {}


def parse_rate(text: str) -> RateLimit | None:
    """The limit "1000/1s", None for "infinity"; raises DoraSystemdError (USAGE)."""
    if text.strip() == "infinity":
        return None
    lines, slash, time = (part.strip() for part in text.partition("/"))
    if not (slash and lines.isascii() and lines.isdigit() and len(lines) < 19 and int(lines)):
        raise _refusal(text)
    try:
        interval = parse_duration(time)
    except DoraSystemdError as error:
        raise _refusal(text) from error
    if not SHORTEST <= interval < INFINITY:
        raise _refusal(text)
    return RateLimit(int(lines), interval)


def format_rate(limit: RateLimit | None) -> str:
    """The text from which parse_rate makes `limit`."""
    if limit is None:
        return "infinity"
    return f"{limit.lines}/{format_duration(limit.interval)}"


_KEY = "log_rate_limit"


def rates_of(options: RunnerOptions) -> RateLimits:
    """The limits of the dataflow and of single nodes. Raises DoraSystemdError."""
    if not options.has(_KEY):
        return UNLIMITED
    of_all = options.of_dataflow(_KEY)
    return {**({ALL_NODES: of_all} if of_all else {}), **options.by_node(_KEY)}


def rate_texts(limits: RateLimits) -> list[SettingText]:
    """The limits as settings of the runner."""
    return [SettingText(node, _KEY, format_rate(limit)) for node, limit in limits.items()]


def rate_of(limits: RateLimits, node: str) -> RateLimit | None:
    """The limit of one node, or None."""
    return limits[node] if node in limits else limits.get(ALL_NODES)


def _refusal(text: str) -> DoraSystemdError:
    return usage_error(f"cannot read {quoted(text)} as a rate of lines", HINT)


def check_rates(limits: RateLimits, nodes: Sequence[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a limit of a node that is not in `nodes`."""
    check_known("cannot limit the lines of", filter(None, limits), nodes)


@dataclass
class _Window:
    end: float
    left: int


@dataclass
class LineLimiter:
    """Counts the lines of one node.

    Each stream has its own window, so that a flood on standard output does not suppress a traceback
    on standard error. A window begins with the first line after the last window.
    """

    limit: RateLimit
    suppressed: int = 0  # number of refused lines since take_suppressed()
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
