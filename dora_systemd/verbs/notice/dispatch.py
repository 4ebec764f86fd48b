"""Decides when a notice is sent: at once, and later ones with pauses that grow."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from dora_systemd.adapters.bus.manager import DOWN, Manager
from dora_systemd.adapters.host import notify
from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.query import notice_matches, sent_matches
from dora_systemd.decisions.notice.happened import (
    FAILED,
    FIRST_PAUSE,
    MOST_ENDS,
    Happened,
    Story,
    next_pause,
    pause_left,
    read_last,
    read_story,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import notice_unit, unit_name
from dora_systemd.paths import LAST_REQUEST
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import exists
from dora_systemd.trust.tree import clear_directory
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.lives import now_boot

SETTLE_SECONDS = 1.0
"""Failures come together, and journald may not have written them yet."""

END_SECONDS = 10
"""Longest time between the last request of a runner and the failure of its unit."""
POLL_SECONDS = 0.2

Send = Callable[[Sequence[Happened], int], None]
"""Sends a notice of failures, newest first, and records it with the pause that follows, in µs."""


def monotonic_us() -> int:
    """Read CLOCK_MONOTONIC in µs, as the journal does."""
    return time.monotonic_ns() // 1000


def read_journal(journal: JournalReader, scope: Scope, name: str) -> Story:
    """Read what has happened to a dataflow since its last notice. Raises DoraSystemdError."""
    boot, now_us = now_boot(), monotonic_us()
    last = read_last(journal.newest(sent_matches(scope, name), MOST_ENDS), boot, now_us)
    return read_story(journal.newest(notice_matches(scope, name), None), boot, now_us, last)


class Dispatcher:
    """Sends notices of one dataflow until there is nothing to report.

    read: what has happened; it raises DoraSystemdError if the journal cannot be read. learn: reads
    the dataflow, before each pause, in which it may be stopped.
    """

    def __init__(
        self,
        manager: Manager,
        scope: Scope,
        name: str,
        read: Callable[[], Story],
        learn: Callable[[], None],
        send: Send,
        sleep: Callable[[float], None] = time.sleep,
        now_us: Callable[[], int] = monotonic_us,
    ) -> None:
        self._manager, self._scope, self._name = manager, scope, name
        self._read, self._learn, self._send = read, learn, send
        self._sleep, self._now_us = sleep, now_us

    def run(self) -> None:
        """Send a notice of what has happened, and again as long as something has happened since.

        systemd drops the start of a service that runs. So the service reports its end first, by
        STOPPING=1: a start that comes later waits until this process has ended. Then the service
        reads the journal one last time, which has each failure from before STOPPING=1.
        """
        self._sleep(SETTLE_SECONDS)
        while self._work():
            pass
        notify.send_stopping()
        self._sleep(SETTLE_SECONDS)
        with suppress(DoraSystemdError):
            self._start_again()

    def _start_again(self) -> None:
        """Start this service again if something has happened. Raises DoraSystemdError."""
        if self._read()[0]:
            self._manager.queue_job("StartUnit", notice_unit(self._name))

    def _work(self) -> bool:
        """Send one notice, or wait until it may be sent; whether there was anything to report."""
        is_last = exists(self._scope.notice_directory(self._name) / LAST_REQUEST)
        self._learn()
        self._clear_requests()
        if is_last:
            self._await_end()
        try:
            happened, last = self._read()
        except DoraSystemdError as error:
            self._send_unread(error)
            return False
        if not happened:
            return False
        if left := pause_left(last, self._now_us()):
            self._sleep(left / SECOND)
            return True
        self._send(happened, next_pause(last, self._now_us()))
        self._sleep(SETTLE_SECONDS)  # journald has to write the record of this notice
        return True

    def _await_end(self) -> None:
        """Wait for the final failure of the unit, see runner/cell/notices.py."""
        unit, deadline = unit_name(self._name), self._now_us() + END_SECONDS * SECOND
        with suppress(DoraSystemdError):
            while self._manager.read(unit, ["ActiveState"])["ActiveState"] not in DOWN:
                if self._now_us() > deadline:
                    return
                self._sleep(POLL_SECONDS)
        self._sleep(SETTLE_SECONDS)

    def _send_unread(self, error: DoraSystemdError) -> None:
        """Send a notice of a failure that the journal does not show, and keep the pause here."""
        at_us = time.time_ns() // 1000
        failure = Happened(FAILED, at_us, self._now_us(), cause=error.message)
        self._send([failure], FIRST_PAUSE)
        self._sleep(FIRST_PAUSE / SECOND)

    def _clear_requests(self) -> None:
        """Remove the files by which the runner has requested notices.

        Its user can write anything there. What cannot be removed would start this service again
        and again, so then the unit that starts it is stopped.
        """
        directory = self._scope.notice_directory(self._name)
        if not clear_directory(directory):
            self._manager.queue_job("StopUnit", notice_unit(self._name, ".path"))
