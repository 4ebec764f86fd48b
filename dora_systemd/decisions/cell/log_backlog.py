"""Decides when to freeze a node because too much of its output in dora's log files is unread.

dora deletes rotated files whether they have been read or not. A node whose output dora reads is not
slowed by a full pipe, so the runner freezes it in time.
"""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

_BOUNDS = {"max_log_size": "16MB", "max_rotated_files": 1}
"""Limits for these log files, which are in the RuntimeDirectory and so in memory."""
_SIZE = r"(?i)([0-9]{1,18}) *([KMG]?)B?"
_FACTORS = {"": 1, "K": 1000, "M": 1000**2, "G": 1000**3}
BREATH = 0.02
"""Seconds that a node runs at least between two freezes: it has other work to do."""


class Marks(NamedTuple):
    """Thresholds for freezing a node, in bytes that dora wrote and the runner has not read."""

    hold: int  # freeze from here on
    free: int  # thaw below this
    longest: float = float("inf")  # maximum seconds of one freeze

    def is_held(self, was_held: bool, seconds: float, backlog: int) -> bool:
        """Whether to freeze a node that was frozen, or ran, for so long. backlog: unread bytes."""
        if was_held:
            return backlog >= self.free and seconds < self.longest
        return backlog >= self.hold and seconds >= BREATH


MARKS = Marks(2_000_000, 1_000_000)
"""Nodes are frozen as rarely as possible: a freeze interrupts a write above PIPE_BUF, and `python
-u` does not write the rest. A freeze lasts at most about half a second. 14 MB are left for what
dora writes until the next check, and has read by then."""


def with_bounds(raw: Mapping[str, Any]) -> dict[str, Any]:
    """A node of the descriptor, with limits for its log files unless it has its own."""
    return {**_BOUNDS, **{key: value for key, value in raw.items() if value is not None}}


def marks_of(raw: Mapping[str, Any]) -> Marks:
    """Thresholds for the node's own limits, so that dora deletes nothing before they are reached.

    A frozen node does not answer dora's health check: so one freeze takes a quarter of its timeout.
    """
    bounds, timeout = with_bounds(raw), raw.get("health_check_timeout")
    capacity = _capacity(bounds["max_log_size"], bounds["max_rotated_files"])
    # With a mark of 0, a node would be frozen for ever: nothing is less.
    hold = max(min(MARKS.hold, capacity // 4), 1)
    longest = timeout / 4 if isinstance(timeout, int | float) else MARKS.longest
    return Marks(hold, max(hold // 2, 1), longest)


def _capacity(size: object, files: object) -> int:
    match = re.fullmatch(_SIZE, str(size))
    if match is None or not isinstance(files, int):
        return 4 * MARKS.hold
    return int(match[1]) * _FACTORS[match[2].upper()] * max(files, 1)
