"""Tells systemd that a link is alive: see WatchdogSec= in systemd.service(5).

A link that hangs looks to the head like a machine that is away, and nobody else would end it.
"""

import os
import socket
import time
from contextlib import suppress

_PAUSE_SECONDS = 1.0


class Watchdog:
    """Sends WATCHDOG=1 at most once a second; does nothing without NOTIFY_SOCKET."""

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._last = float("-inf")

    def feed(self) -> None:
        """Call it wherever the link goes on."""
        now = time.monotonic()
        if self._address and now - self._last >= _PAUSE_SECONDS:
            self._last = now
            kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
            with suppress(OSError), socket.socket(socket.AF_UNIX, kind) as one:
                one.sendto(b"WATCHDOG=1", self._address)
