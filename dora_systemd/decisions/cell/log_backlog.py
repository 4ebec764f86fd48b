"""How much dora's own log files of one node hold, and from when on the node has to wait for us.

Dora deletes what it has rotated out whether we have read it or not. A node whose output dora reads
is not slowed by that, so it has to be held before it comes to it: as one is that blocks in writing.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_BOUNDS = {"max_log_size": "16MB", "max_rotated_files": 1}
"""What they may take of the RuntimeDirectory, which is memory."""
_SIZE = re.compile(r"([0-9]+) *([KMG]?)B?", re.IGNORECASE)
_FACTORS = {"": 1, "K": 1000, "M": 1000**2, "G": 1000**3}
BREATH = 0.02
"""Seconds that a node runs at least before it waits again: it has other things to do."""


@dataclass(frozen=True)
class Marks:
    """When a node waits, by the bytes that dora has written and we have not read.

    hold: from here on. free: below this it goes on. longest: it waits so many seconds at most.
    """

    hold: int
    free: int
    longest: float = float("inf")

    def is_held(self, was_held: bool, seconds: float, backlog: int) -> bool:
        """Whether a node waits, when it has waited, or run, for so long and so much is unread."""
        if was_held:
            return backlog >= self.free and seconds < self.longest
        return backlog >= self.hold and seconds >= BREATH


MARKS = Marks(2_000_000, 1_000_000)
"""A node is not stopped oftener than it must be: it cuts short what the node is just writing, if
that is above PIPE_BUF, and `python -u` does not write the rest. Nor for longer than about half a
second. 14 MB are left for what dora writes until we look again, and has itself taken by then."""


def with_bounds(raw: Mapping[str, Any]) -> dict[str, Any]:
    """A node of the descriptor, with bounds for its log files where it has none of its own."""
    return {**_BOUNDS, **{key: value for key, value in raw.items() if value is not None}}


def marks_of(raw: Mapping[str, Any]) -> Marks:
    """Marks that suit the node's own bounds: nothing is deleted before these are full.

    A node that waits does not answer dora either: one with a health check waits a quarter of its
    time at once.
    """
    bounds, timeout = with_bounds(raw), raw.get("health_check_timeout")
    hold = min(MARKS.hold, _capacity(bounds["max_log_size"], bounds["max_rotated_files"]) // 4)
    longest = timeout / 4 if isinstance(timeout, int | float) else MARKS.longest
    return Marks(hold, hold // 2, longest)


def _capacity(size: object, files: object) -> int:
    match = _SIZE.fullmatch(str(size))
    if match is None or not isinstance(files, int):
        return 4 * MARKS.hold
    return int(match[1]) * _FACTORS[match[2].upper()] * max(files, 1)
