"""Sends entries to journald's datagram socket, in its native protocol.

https://systemd.io/JOURNAL_NATIVE_PROTOCOL/
"""

import asyncio
import contextlib
import errno
import fcntl
import os
import select
import socket
import sys
import termios
import time
from collections.abc import Callable
from functools import partial

from dora_systemd.adapters.journal.note import JOURNAL_SOCKET

# journald takes the entries of all senders from one queue, in order. So a line of a quiet node
# waits for what one flood has in that queue: some 50 entries (about 1.3 kB each in the kernel) or
# 1.4 ms with this size. A smaller buffer makes the runner wake up more often, which takes CPU time
# from journald, the bottleneck; a larger one is not faster.
BULK_BUFFER = 1 << 16
EXPRESS_BUFFER = 1 << 20
RETRY_SECONDS = 0.05
UNREAD_SECONDS = 0.002

_TOO_BIG = {errno.EMSGSIZE, errno.ENOBUFS}
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL


class JournalSocket:
    """Sends entries to journald without blocking; the caller keeps those that are refused.

    path: the socket; tests use another one.
    """

    def __init__(self, path: str = JOURNAL_SOCKET) -> None:
        self._express = _Channel(path, EXPRESS_BUFFER)
        self._bulk = _Channel(path, BULK_BUFFER)

    def send(self, entry: bytes) -> bool:
        """Send one entry; False: refused, journald is busy or restarting, see call_when_ready()."""
        return self._express.send(entry)

    def send_bulk(self, entry: bytes) -> bool:
        """Send one entry of a flood, which leaves room in journald's queue for other entries."""
        return self._bulk.send(entry)

    @property
    def sent(self) -> int:
        """Number of entries that journald has taken so far."""
        return self._express.sent + self._bulk.sent

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        """From now on call `callback` each time a refused entry may be sent again.

        A new callback replaces the last one.
        """
        for channel in (self._express, self._bulk):
            channel.call_when_ready(loop, callback)

    def wait_ready(self, seconds: float) -> None:
        """Block until a refused entry may be sent again, at most `seconds`. Only for the end."""
        for channel in (self._express, self._bulk):
            if channel.refused:
                channel.wait_ready(seconds)

    def wait_read(self, seconds: float) -> None:
        """Block until journald has read everything, at most `seconds`. Call this before exiting.

        journald finds the unit of an entry by the sender's pid, which fails after the process is
        gone.
        """
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and (self._express.unread or self._bulk.unread):
            time.sleep(UNREAD_SECONDS)
        time.sleep(UNREAD_SECONDS)  # for the entry that journald has just read

    def close(self) -> None:
        """Close the sockets, and drop the callback."""
        self._express.close()
        self._bulk.close()


class _Channel:
    """One socket connected to journald; reconnects after journald has restarted."""

    def __init__(self, path: str, buffer: int) -> None:
        self._path = path
        self._buffer = buffer
        self._socket: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._callback: Callable[[], None] = _ignore
        self._cancel: Callable[[], object] = _ignore
        self.sent = 0
        # Set until the callback: other entries may get through before that.
        self.refused = False

    def send(self, entry: bytes) -> bool:
        try:
            (self._socket or self._connect()).send(entry)
        except OSError as error:
            if not self._send_otherwise(error, entry):
                self._refuse()
                return False
        self.sent += 1
        return True

    def _connect(self) -> socket.socket:
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._buffer // 2)  # doubled there
        try:
            sock.connect(self._path)
        except OSError:
            sock.close()
            raise
        self._socket = sock
        return sock

    def _send_otherwise(self, error: OSError, entry: bytes) -> bool:
        if isinstance(error, BlockingIOError):
            return False
        if error.errno in _TOO_BIG and self._socket is not None:
            return self._send_memfd(self._socket, entry)
        was_connected = self._socket is not None
        self._disconnect()
        if was_connected:
            # journald has restarted, and may have its new socket already.
            with contextlib.suppress(OSError):
                self._connect().send(entry)
                return True
        return False

    def _send_memfd(self, sock: socket.socket, entry: bytes) -> bool:
        """Send a large entry as a sealed file, as sd_journal_send(3) does."""
        try:
            fd = os.memfd_create("dora-journal-entry", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            with os.fdopen(fd, "wb") as file:
                file.write(entry)
                file.flush()
                fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
                socket.send_fds(sock, [b""], [fd])
        except BlockingIOError:
            return False
        except OSError:
            self._disconnect()
            return False
        return True

    @property
    def unread(self) -> int:
        """Bytes still in the socket's queue: SIOCOUTQ in unix(7) and tcp(7)."""
        if self._socket is None:
            return 0
        return int.from_bytes(fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4)), sys.byteorder)

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        self._loop, self._callback = loop, callback
        self._arm()

    def wait_ready(self, seconds: float) -> None:
        poll = select.poll()
        if self._socket is None:
            seconds = min(seconds, RETRY_SECONDS)
        else:
            poll.register(self._socket, select.POLLOUT)
        poll.poll(max(seconds, 0.0) * 1000)  # a negative number would mean forever

    def _refuse(self) -> None:
        if not self.refused:
            self.refused = True
            self._arm()

    def _arm(self) -> None:
        """Have the loop call _ready() when a refused entry may be sent again."""
        self._disarm()
        if not self.refused or self._loop is None:
            return
        if self._socket is None:
            self._cancel = self._loop.call_later(RETRY_SECONDS, self._ready).cancel
            return
        fd = self._socket.fileno()
        self._loop.add_writer(fd, self._ready)
        self._cancel = partial(self._loop.remove_writer, fd)

    def _disarm(self) -> None:
        self._cancel()
        self._cancel = _ignore

    def _ready(self) -> None:
        self._disarm()
        self.refused = False
        self._callback()

    def _disconnect(self) -> None:
        self._disarm()
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._arm()

    def close(self) -> None:
        self.refused = False
        self._disconnect()


def _ignore() -> None:
    """Do nothing, until a callback is set."""
