"""Sends WATCHDOG=1 from a thread of its own, because anything in the event loop may be held up.

A machine without time to spare, a disk or a kernel that keeps a call waiting: none of these is a
reason to end healthy nodes. A runner that is stopped sends nothing, and so does one whose loop has
stood still for PATIENCE_SECONDS: both hang.
"""

import asyncio
import threading
import time
from collections.abc import Callable

from dora_systemd.adapters.host import notify

PATIENCE_SECONDS = 120.0


class Keepalive:
    """Tells systemd that the runner is alive.

    seconds: between two messages. patience: seconds that the loop may stand still.
    """

    def __init__(
        self,
        seconds: float,
        send: Callable[[], None] = notify.send_alive,
        patience: float = PATIENCE_SECONDS,
    ) -> None:
        self._seconds = seconds
        self._send = send
        self._patience = patience
        self._beat = time.monotonic()
        self._ended = threading.Event()

    async def beat(self) -> None:
        """Send messages while the loop goes round, without end."""
        threading.Thread(target=self._run, name="keepalive", daemon=True).start()
        try:
            while True:
                self._beat = time.monotonic()
                await asyncio.sleep(self._seconds)
        finally:
            self._beat = time.monotonic()

    def end(self) -> None:
        """Send no more messages."""
        self._ended.set()

    def _run(self) -> None:
        while not self._ended.wait(self._seconds):
            if time.monotonic() - self._beat < self._patience:
                self._send()
