"""Decides when a node has missed its watchdog. Pure: the time is in the arguments.

The watchdog of a node starts when the node runs, as that of a unit does when its start-up is
complete: before, Node() blocks until all nodes of the dataflow are ready. Each process has a new
one. A node that starts again while the others run has a limit for its start-up, too.

The clock leaves out time in which the runner itself did not run. So no sign counts as missed
because the machine was suspended or had no time to spare, or the cell was stopped.
"""

from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from dora_systemd.values import INFINITY, SECOND, format_duration

_LOOKS = 8
"""Looks of the runner in the time of the shortest watchdog."""
_SLOWEST = 5 * SECOND
LONGEST = 90 * SECOND
"""µs for a start-up and for an end by SIGABRT, as DefaultTimeoutStartSec= and
DefaultTimeoutAbortSec= of systemd-system.conf(5)."""


def period_of(limits: Iterable[int]) -> int:
    """µs between two looks, for these watchdogs."""
    return min([_SLOWEST, *(limit // _LOOKS for limit in limits)])


class Clock(NamedTuple):
    """CLOCK_MONOTONIC without the time that was lost. All in µs."""

    period: int  # of the looks
    seen: int  # the last time at which the runner ran for sure
    lost: int = 0

    @property
    def now(self) -> int:
        """µs that have passed for the runner and its nodes."""
        return self.seen - self.lost

    def at(self, monotonic: int) -> "Clock":
        """The clock at a later time: a gap of more than two periods counts as one period."""
        gap = monotonic - self.seen
        skipped = gap - self.period if gap > 2 * self.period else 0
        return self._replace(seen=monotonic, lost=self.lost + skipped)


class Phase(Enum):
    """The phase of a node. AWAY: no WATCHDOG=1 is expected."""

    AWAY = 0
    STARTING = 1
    RUNNING = 2


def limit_in(phase: Phase, watchdog: int, start_timeout: int) -> int:
    """µs without a sign after which a node has missed its watchdog; INFINITY without one."""
    if phase is Phase.RUNNING or watchdog == INFINITY:
        return watchdog
    return start_timeout if start_timeout < INFINITY else max(watchdog, LONGEST)


class Act(Enum):
    """The action of a watchdog on a node."""

    NOTHING = "nothing"
    ABORT = "SIGABRT"
    KILL = "SIGKILL"


class Watch(NamedTuple):
    """The watch over one process of a node in one phase. Times are those of Clock.now."""

    phase: Phase = Phase.AWAY
    pid: int = 0
    since: int = 0  # its last sign, or when the watch began
    aborted: int | None = None  # when it was sent SIGABRT, or None
    is_killed: bool = False

    @property
    def is_awake(self) -> bool:
        """Whether the node can miss something."""
        return self.phase is not Phase.AWAY and self.aborted is None

    def of(self, phase: Phase, pid: int, signed: int | None, now: int) -> "Watch":
        """The watch now. signed: when the last sign came, None without one."""
        if (phase, pid) != (self.phase, self.pid):
            return Watch(phase, pid, now)
        return self if signed is None else self._replace(since=max(self.since, signed))

    def excused(self, now: int) -> "Watch":
        """The node could not run, because of us: its time starts again."""
        return self._replace(since=now)

    def act(self, limit: int, grace: int, now: int) -> Act:
        """Return the action for the watchdog `limit`. grace: µs between SIGABRT and SIGKILL."""
        if self.aborted is None:
            is_late = self.is_awake and limit < INFINITY and now - self.since >= limit
            return Act.ABORT if is_late else Act.NOTHING
        is_over = now - self.aborted >= min(grace, LONGEST) and not self.is_killed
        return Act.KILL if is_over else Act.NOTHING


# Journals keep these texts, so they never change.
TRIGGERED = "it sent WATCHDOG=trigger"
LATE = "not ready within "
_SAYS = {Phase.RUNNING: "no WATCHDOG=1 for ", Phase.STARTING: LATE}


def missed(phase: Phase, limit: int) -> str:
    """The reason for a watchdog of `limit` µs."""
    return f"{_SAYS[phase]}{format_duration(limit)}"


def by_watchdog(reason: str) -> bool:
    """Whether a node hung for one of these reasons, and not by dora's health check."""
    return reason == TRIGGERED or reason.startswith(tuple(_SAYS.values()))
