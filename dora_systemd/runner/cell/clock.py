"""The clock of a stop: every step at the end asks it how long it may take."""

import time
from collections.abc import Callable

from dora_systemd.decisions.life.stop_budget import runner_timeout
from dora_systemd.values import INFINITY, SECOND

STOP_SECONDS = 7.0
BACKLOG_SECONDS = 60.0
"""Timeouts for journald to take what the nodes have written: when a stop was requested, and when
none was."""


class StopClock:
    """Starts with the first stop request. grace: of the dataflow, µs.

    by: what requested the stop, or "".
    """

    def __init__(self, grace: int, now: Callable[[], float] = time.monotonic) -> None:
        self._grace = grace
        self._now = now
        self._began = 0.0
        self.by = ""

    def begin(self, by: str) -> None:
        """Start the clock; only the first call counts."""
        if not self.by:
            self._began, self.by = self._now(), by

    def left(self, most: float) -> float:
        """Seconds left for a step that may take at most `most` seconds."""
        timeout = runner_timeout(self._grace)
        if self.by and timeout != INFINITY:
            most = min(most, self._began + timeout / SECOND - self._now())
        return max(most, 0.0)

    def for_journal(self) -> Callable[[], float]:
        """A function for the seconds that journald may still take; a stop request shortens them."""
        begin = self._now()

        def left() -> float:
            most = STOP_SECONDS if self.by else BACKLOG_SECONDS
            return self.left(max(begin, self._began) + most - self._now())

        return left
