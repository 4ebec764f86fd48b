"""Answers at the runner's socket while the rest of the runner is imported.

A link needs nothing but the ports to log in, and that takes longer than all imports. Whatever else
comes is kept for listener.py. Imports only what loads quickly.
"""

import contextlib
import os
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import NamedTuple

_SECONDS = 0.5
"""Timeout of a request: only the user of the nodes and root can connect."""
_CHUNK = 1 << 16
Greet = Callable[[bytes], tuple[bytes, bytes]]
"""Returns the answer to a line, b"" for nothing yet, and what replaces the line from then on."""


def listen(path: Path) -> socket.socket:
    """A listener at `path` for its user alone. Raises OSError."""
    path.unlink(missing_ok=True)
    with _short(path) as address, contextlib.ExitStack() as undo:
        listener = undo.enter_context(socket.socket(socket.AF_UNIX))
        listener.bind(address)
        path.chmod(0o600)
        listener.listen()
        undo.pop_all()
        return listener


@contextlib.contextmanager
def _short(path: Path) -> Iterator[str]:
    """A short path for the socket: an address has 107 bytes, see unix(7), and a name up to 200."""
    directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{directory}/{path.name}"
    finally:
        os.close(directory)


class Kept(NamedTuple):
    """A connection."""

    connection: socket.socket
    said: bytes  # the bytes that were received


class Door:
    """Listens at `path` and answers by `greet`, until hand_over(). Raises OSError."""

    def __init__(self, path: Path, greet: Greet) -> None:
        self._listener, self._greet = listen(path), greet
        self._kept: list[Kept] = []
        self._over, self._end = os.pipe2(os.O_CLOEXEC)
        self._work = Thread(target=self._keep, daemon=True)
        self._work.start()

    def hand_over(self) -> tuple[socket.socket, list[Kept]]:
        """Stop, and return the listener and the accepted connections. Call hand_over() once."""
        os.close(self._end)
        self._work.join()
        os.close(self._over)
        return self._listener, self._kept

    def close(self) -> None:
        """Close the socket and all connections, if no event loop takes them over."""
        listener, kept = self.hand_over()
        for one in (listener, *(one.connection for one in kept)):
            one.close()

    def _keep(self) -> None:
        poll = select.poll()
        for fd in (self._over, self._listener.fileno()):
            poll.register(fd, select.POLLIN)
        while self._over not in {fd for fd, _ in poll.poll()}:
            with suppress(OSError):
                connection, _ = self._listener.accept()
                connection.settimeout(_SECONDS)
                self._kept.append(self._met(connection))

    def _met(self, connection: socket.socket) -> Kept:
        said = b""
        with suppress(OSError):
            said = connection.recv(_CHUNK)
            line, newline, rest = said.partition(b"\n")
            answer, line = self._greet(line) if newline else (b"", line)
            said = line + newline + rest
            connection.sendall(answer)
        return Kept(connection, said)
