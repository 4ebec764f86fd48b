"""The serial line of a kernel in user mode, made a socket that loses nothing.

That kernel stops reading a line for good once the terminal behind it has been full. So never more
is on its way there than fits: the agent acknowledges what it has read.
"""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from lab.wire import pack_frame, read_frame

# A terminal is full with 4096 bytes.
WINDOW = 2048


@contextmanager
def steady_line(far: socket.socket) -> Iterator[socket.socket]:
    """A socket whose other end is the line `far`."""
    ours, near = socket.socketpair()
    line = _Line(far, near)
    threads = [threading.Thread(target=one, daemon=True) for one in (line.write, line.read)]
    for thread in threads:
        thread.start()
    try:
        yield ours
    finally:
        for end in (ours, far):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
        ours.close()


class _Line:
    def __init__(self, far: socket.socket, near: socket.socket) -> None:
        self.far = far
        self.near = near
        self.unread = 0  # bytes that the agent has not acknowledged
        self.changed = threading.Condition()

    def write(self) -> None:
        self._until_the_end(self._write_piece)

    def read(self) -> None:
        self._until_the_end(self._read_frame)

    def _until_the_end(self, step: Callable[[], None]) -> None:
        with suppress(OSError, EOFError):
            while True:
                step()
        with suppress(OSError):
            self.near.shutdown(socket.SHUT_RDWR)
        self._count(-self.unread)

    def _write_piece(self) -> None:
        piece = self.near.recv(WINDOW // 2)
        if not piece:
            raise EOFError
        with self.changed:
            self.changed.wait_for(lambda: self.unread + len(piece) <= WINDOW)
            self.unread += len(piece)
        self.far.sendall(piece)

    def _read_frame(self) -> None:
        kind, body = read_frame(self.far.recv)
        if kind == b"A":
            self._count(-int(body))
            return
        if kind == b"H":  # it has booted anew, and what it had not read is gone
            self._count(-self.unread)
        self.near.sendall(pack_frame(kind, body))

    def _count(self, more: int) -> None:
        with self.changed:
            self.unread += more
            self.changed.notify()
