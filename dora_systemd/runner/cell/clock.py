"""Time in a cell: the clock of a stop, lost time, and the messages to the watchdog of systemd.

While nothing happens, the process wakes up twice for each tick: at the tick, and when dora answers.
There are two ticks within WatchdogSec=. Before Python 3.13, the thread of the watchdog wakes up at
each tick as well.
"""

import asyncio
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from dora_systemd.adapters.host import notify
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.life.stop_budget import runner_timeout
from dora_systemd.values import INFINITY, SECOND

STOP_SECONDS = 7.0
BACKLOG_SECONDS = 60.0
"""Timeouts for journald to take what the nodes have written: when a stop was requested, and when
none was."""

RECOVERY_SECONDS = 40.0
"""Time for dora's daemon to register again after its coordinator has missed it. Measured: dora
gives it up after 20 to 30 s, and has it back within seconds, with all nodes."""
_SLACK_SECONDS = 2.0
"""A block that takes so much longer than it may was not running, or had no CPU time."""


_EXTEND_SECONDS = 10.0


async def extend_timeout(extend: Callable[[int], object] = notify.extend_timeout) -> None:
    """Extend the timeout of the job of the unit until this is cancelled, see sd_notify(3)."""
    while True:
        extend(round(3 * _EXTEND_SECONDS * SECOND))
        await asyncio.sleep(_EXTEND_SECONDS)


_TICK_SECONDS = 15.0
"""Longest time between two ticks, half of WatchdogSec= of our units."""


def watchdog_seconds(environment: Mapping[str, str]) -> float | None:
    """Return half of WatchdogSec=, see sd_watchdog_enabled(3); None without it."""
    text = environment.get("WATCHDOG_USEC")
    return int(text) / SECOND / 2 if text else None


class Ticks:
    """One timer for what is done from time to time, so that all of it costs one wakeup.

    watchdog: of watchdog_seconds().
    """

    def __init__(self, watchdog: float | None = None) -> None:
        self.seconds = min(watchdog or _TICK_SECONDS, _TICK_SECONDS)
        self._due: asyncio.Event | None = None

    async def wait(self) -> None:
        """Wait for the next tick, for which other tasks may be waiting already."""
        if self._due is None:
            self._due = asyncio.Event()
            asyncio.get_running_loop().call_later(self.seconds, self._end, self._due)
        await self._due.wait()

    def _end(self, due: asyncio.Event) -> None:
        self._due = None
        due.set()


class Gaps:
    """Notices that this process did not run for a while, as when its unit was frozen.

    now: seconds of a clock that does not stop while this process does not run.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._until = -math.inf

    @contextmanager
    def within(self, seconds: float) -> Iterator[None]:
        """Run a block that takes at most `seconds`, and note a gap if the block takes longer."""
        begun = self._now()
        yield
        if self._now() - begun > seconds + _SLACK_SECONDS:
            self._until = self._now() + RECOVERY_SECONDS

    @property
    def is_recent(self) -> bool:
        """Whether the process did not run a short time ago: what it waits for may need time."""
        return self._now() < self._until


class StopClock:
    """Starts with the first stop request. options: of the dataflow.

    by: what requested the stop, or "".
    """

    def __init__(self, options: RunnerOptions, now: Callable[[], float] = time.monotonic) -> None:
        self._timeout = runner_timeout(options)
        self._now = now
        self._began = 0.0
        self.by = ""

    def begin(self, by: str) -> None:
        """Start the clock; only the first call counts."""
        if not self.by:
            self._began, self.by = self._now(), by

    def left(self, most: float) -> float:
        """Return the seconds left for a step that may take at most `most` seconds."""
        if self.by and self._timeout != INFINITY:
            most = min(most, self._began + self._timeout / SECOND - self._now())
        return max(most, 0.0)

    def for_journal(self) -> Callable[[], float]:
        """Return a function for the seconds left for journald; a stop request shortens them."""
        begin = self._now()

        def left() -> float:
            most = STOP_SECONDS if self.by else BACKLOG_SECONDS
            return self.left(max(begin, self._began) + most - self._now())

        return left


if sys.version_info >= (3, 13):

    class Alarm:
        """Wakes a thread after 4/3 of `seconds` unless put off, and then every `seconds`."""

        def __init__(self, seconds: float) -> None:
            self._fd, self._seconds = os.timerfd_create(time.CLOCK_MONOTONIC), seconds

        def put_off(self) -> None:
            """Begin again."""
            seconds = self._seconds
            os.timerfd_settime(self._fd, initial=4 * seconds / 3, interval=seconds)

        def wait(self) -> None:
            """Wait until it is due."""
            os.read(self._fd, 8)

else:

    class Alarm:
        """Wakes a thread every `seconds`: this Python has no timer that can be put off."""

        def __init__(self, seconds: float) -> None:
            self._seconds = seconds

        def put_off(self) -> None:
            """Do nothing."""

        def wait(self) -> None:
            """Wait until it is due."""
            time.sleep(self._seconds)


PATIENCE_SECONDS = 120.0


class Keepalive:
    """Sends WATCHDOG=1, from its own thread if the event loop does not: anything may hold that up.

    A machine without time to spare, a disk or a kernel that keeps a call waiting: none of these is
    a reason to end healthy nodes. A runner that is stopped sends nothing, and so does one whose
    loop has stood still for PATIENCE_SECONDS: both hang. seconds: between two messages. patience:
    seconds that the loop may stand still.
    """

    def __init__(
        self,
        seconds: float,
        send: Callable[[], None] = notify.send_alive,
        patience: float = PATIENCE_SECONDS,
    ) -> None:
        self._send = send
        self._patience = patience
        self._beat = time.monotonic()
        self._has_ended = False
        self._alarm = Alarm(seconds)

    async def beat(self, ticks: Ticks) -> None:
        """Send messages as long as the event loop runs. Returns only if cancelled."""
        threading.Thread(target=self._run, name="keepalive", daemon=True).start()
        try:
            while True:
                self._alarm.put_off()
                self._send()
                self._beat = time.monotonic()
                await ticks.wait()
        finally:
            self._beat = time.monotonic()

    def end(self) -> None:
        """Send no more messages."""
        self._has_ended = True

    def _run(self) -> None:
        while not self._has_ended:
            self._alarm.wait()
            if time.monotonic() - self._beat < self._patience and not self._has_ended:
                self._send()
