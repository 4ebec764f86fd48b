"""The one clock of a stop, which is handed down to all that takes time at the end."""

import time
from collections.abc import Callable

from dora_systemd.decisions.life.stop_budget import runner_timeout
from dora_systemd.values import INFINITY, SECOND

STOP_SECONDS = 7.0
BACKLOG_SECONDS = 60.0
"""How long journald may take for what the nodes have left to say, when somebody waits for a stop,
and when nobody does."""


class StopClock:
    """Runs from the first stop on. grace: of the dataflow, µs.

    by: who asked for the stop, or "".
    """

    def __init__(self, grace: int, now: Callable[[], float] = time.monotonic) -> None:
        self._grace = grace
        self._now = now
        self._began = 0.0
        self.by = ""

    def begin(self, by: str) -> None:
        """The cell is asked to stop; only the first time counts."""
        if not self.by:
            self._began, self.by = self._now(), by

    def left(self, most: float) -> float:
        """Seconds that something may take which would take `most`."""
        timeout = runner_timeout(self._grace)
        if self.by and timeout != INFINITY:
            most = min(most, self._began + timeout / SECOND - self._now())
        return max(most, 0.0)

    def for_journal(self) -> Callable[[], float]:
        """How long journald may still take, from now on: less as soon as a stop is asked for."""
        begin = self._now()

        def left() -> float:
            most = STOP_SECONDS if self.by else BACKLOG_SECONDS
            return self.left(max(begin, self._began) + most - self._now())

        return left
