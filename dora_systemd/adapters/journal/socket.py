"""The way into journald: its datagram socket, native protocol.

https://systemd.io/JOURNAL_NATIVE_PROTOCOL/
"""

import asyncio
import errno
import fcntl
import os
import select
import socket
import sys
import termios
import time
from collections.abc import Callable

JOURNAL_SOCKET = "/run/systemd/journal/socket"

# journald takes entries of all senders from one queue, in order. What one flood may have waiting
# there (with the kernel's overhead about 1.3 kB an entry) is what a quiet node's line waits for:
# some 50 entries, 1.4 ms. With less the runner wakes up more often, and takes processor time from
# journald, which is the limit; with more nothing gets faster.
BULK_BUFFER = 1 << 16
EXPRESS_BUFFER = 1 << 20
RETRY_SECONDS = 0.05
UNREAD_SECONDS = 0.002

_FULL = {errno.EAGAIN}
_TOO_BIG = {errno.EMSGSIZE, errno.ENOBUFS}
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL


class JournalSocket:
    """Entries to journald, never blocking: what is not taken stays with the caller.

    path: the socket, another one in tests.
    bulk: bytes that entries sent with `send_bulk` may occupy in the kernel at one time.
    """

    def __init__(self, path: str = JOURNAL_SOCKET, bulk: int = BULK_BUFFER) -> None:
        self.path = path
        self._express = _Channel(path, EXPRESS_BUFFER)
        self._bulk = _Channel(path, bulk)

    def send(self, entry: bytes) -> bool:
        """Send one entry; False: not taken, journald is busy or away, see `call_when_ready`."""
        return self._express.send(entry)

    def send_bulk(self, entry: bytes) -> bool:
        """The same for an entry of a flood: it leaves room in journald's queue for others."""
        return self._bulk.send(entry)

    @property
    def sent(self) -> int:
        """How many entries journald has been given so far."""
        return self._express.sent + self._bulk.sent

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        """Call `callback` when an entry that was refused may be sent again.

        It comes once for each of the two ways that refused; asking again replaces what was asked.
        """
        for channel in (self._express, self._bulk):
            if channel.refused:
                channel.call_when_ready(loop, callback)

    def wait_ready(self, seconds: float) -> None:
        """Block until a refused entry may be sent again, at most `seconds`: for the very end."""
        for channel in (self._express, self._bulk):
            if channel.refused:
                channel.wait_ready(seconds)

    def wait_read(self, seconds: float) -> None:
        """Block until journald has read all that was sent, at most `seconds`: before exiting.

        It learns the unit of an entry from its sender's pid, and not from a process that is gone.
        """
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and (self._express.unread or self._bulk.unread):
            time.sleep(UNREAD_SECONDS)
        time.sleep(UNREAD_SECONDS)  # for the entry that it has just read

    def close(self) -> None:
        """Close the sockets and forget the callbacks."""
        self._express.close()
        self._bulk.close()


class _Channel:
    """One socket connected to journald, made again when journald came back."""

    def __init__(self, path: str, buffer: int) -> None:
        self._path = path
        self._buffer = buffer
        self._socket: socket.socket | None = None
        self._waiter: tuple[asyncio.AbstractEventLoop, Callable[[], None]] | None = None
        self._cancel: Callable[[], object] | None = None
        self.sent = 0
        # Stays set until the waiter has been called: other entries may get through before.
        self.refused = False

    def send(self, entry: bytes) -> bool:
        try:
            (self._socket or self._connect()).send(entry)
        except OSError as error:
            if not self._send_otherwise(error, entry):
                self.refused = True
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
        if error.errno in _FULL:
            return False
        if error.errno in _TOO_BIG and self._socket is not None:
            return self._send_memfd(self._socket, entry)
        was_connected = self._socket is not None
        self._disconnect()
        # Restarted: its new socket may be there already.
        return was_connected and self._send_again(entry)

    def _send_again(self, entry: bytes) -> bool:
        try:
            self._connect().send(entry)
        except OSError:
            return False
        return True

    def _send_memfd(self, sock: socket.socket, entry: bytes) -> bool:
        """Hand over a big entry as a sealed file, as sd_journal_send(3) does."""
        fd = os.memfd_create("dora-journal-entry", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            with os.fdopen(os.dup(fd), "wb") as file:
                file.write(entry)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
            socket.send_fds(sock, [b""], [fd])
        except OSError as error:
            if error.errno not in _FULL:
                self._disconnect()
            return False
        finally:
            os.close(fd)
        return True

    @property
    def unread(self) -> int:
        """Bytes that are still in the socket's queue: SIOCOUTQ in unix(7) and tcp(7)."""
        if self._socket is None:
            return 0
        return int.from_bytes(fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4)), sys.byteorder)

    def call_when_ready(
        self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]
    ) -> None:
        self._waiter = (loop, callback)
        self._arm()

    def wait_ready(self, seconds: float) -> None:
        if self._socket is None:
            time.sleep(min(seconds, RETRY_SECONDS))
            return
        poll = select.poll()
        poll.register(self._socket, select.POLLOUT)
        poll.poll(seconds * 1000)

    def _arm(self) -> None:
        self._disarm()
        if self._waiter is None:
            return
        loop = self._waiter[0]
        if self._socket is None:
            self._cancel = loop.call_later(RETRY_SECONDS, self._ready).cancel
            return
        fd = self._socket.fileno()
        loop.add_writer(fd, self._ready)
        self._cancel = lambda: loop.remove_writer(fd)

    def _ready(self) -> None:
        self._disarm()
        self.refused = False
        waiter, self._waiter = self._waiter, None
        if waiter is not None:
            waiter[1]()

    def _disarm(self) -> None:
        cancel, self._cancel = self._cancel, None
        if cancel is not None:
            cancel()

    def _disconnect(self) -> None:
        self._disarm()
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._arm()

    def close(self) -> None:
        self._waiter = None
        self._disconnect()
