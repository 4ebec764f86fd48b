"""Counts the entries that journald drops in user scope, where its rate limit cannot be lifted.

All services of a user share one limit, RateLimitBurst= in journald.conf(5). journald reports what
it drops in the system journal, which the user may not read. So LossWatch compares the number of
entries sent with the number stored.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable

from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import scope_of

CHECK_TICKS = 2
"""Ticks between two checks: together RateLimitIntervalSec= of journald, 30 s by default."""

# Fewer entries than this cannot exceed a rate limit, so they are not counted.
WORTH = 1000
# Entries that may be in the socket at that moment, see BULK_BUFFER of JournalSocket.
ON_ITS_WAY = 512
_SETTLE_SECONDS = 0.2

Count = Callable[[int, int], int]


class LossWatch:
    """Compares the numbers of entries sent and stored.

    sent: how many entries journald has taken so far. count: how many it has stored in [since,
    until], CLOCK_REALTIME µs; may block. report: called with the number of newly lost entries.
    """

    def __init__(
        self,
        sent: Callable[[], int],
        count: Count,
        report: Callable[[int], None],
        now_us: Callable[[], int],
    ) -> None:
        self._sent = sent
        self._count = count
        self._report = report
        self._now_us = now_us
        self._since = now_us()
        self._base = sent()
        self._seen = self._base
        self._stored = 0
        self._lost = 0
        # Whether the last check found a difference that is not reported yet.
        self._is_open = False

    async def run(self, wait: Callable[[], Awaitable[None]]) -> None:
        """Check every CHECK_TICKS, forever. wait: for the next tick."""
        while True:
            for _ in range(CHECK_TICKS):
                await wait()
            await self.check()

    async def check(self, tolerance: int = ON_ITS_WAY) -> None:
        """Check now; a difference of up to `tolerance` entries waits for the next check."""
        sent = self._sent()
        if sent - self._seen < WORTH and not self._is_open:
            return
        until = self._now_us()
        try:
            self._stored += await asyncio.to_thread(self._count, self._since, until - 1)
        except (DoraSystemdError, RuntimeError):
            return  # the journal, or a thread, is not to be had now: the next check counts it all
        self._since, self._seen = until, sent
        lost = sent - self._base - self._stored
        if lost - self._lost > tolerance:
            self._report(lost - self._lost)
            self._lost = lost
        self._is_open = lost > self._lost

    async def finish(self) -> None:
        """Check without a tolerance, after everything has been sent."""
        if self._sent() - self._base < WORTH:
            return
        await asyncio.sleep(_SETTLE_SECONDS)
        self._is_open = True
        await self.check(tolerance=0)


def losses_of_user(journal: JournalSocket, pipes: LogPipes) -> LossWatch | None:
    """Create a LossWatch for the services of this user; None without a readable journal."""
    from dora_systemd.adapters.journal.reader import JournalReader, check_readable

    def report(count: int) -> None:
        pipes.write_event("lines-lost", count=count, reason="rate limit of journald")

    try:
        check_readable(scope_of(True))
    except DoraSystemdError:
        return None
    reader = JournalReader()
    return LossWatch(lambda: journal.sent, reader.count_own, report, lambda: time.time_ns() // 1000)
