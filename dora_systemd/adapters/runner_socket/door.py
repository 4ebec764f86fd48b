"""Answers at the runner's socket while the rest of the runner is imported.

A link needs nothing but the ports to log in, and that takes longer than all imports. Whatever else
comes is kept for listener.py. Imports only what loads quickly.
"""

import os
import select
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import NamedTuple

from dora_systemd.adapters.runner_socket.address import listen

_SECONDS = 0.5
"""For a request: only the user of the nodes and root can connect."""
_CHUNK = 1 << 16

Greet = Callable[[bytes], tuple[bytes, bytes]]
"""What to answer to a line, b"" for nothing yet, and what is to be taken for that line later."""


class Kept(NamedTuple):
    """A connection. said: what has been read of it."""

    connection: socket.socket
    said: bytes


class Door:
    """Listens at `path`, and greets, until hand_over(). Raises OSError."""

    def __init__(self, path: Path, greet: Greet) -> None:
        self._listener, self._greet = listen(path), greet
        self._kept: list[Kept] = []
        self._over, self._end = os.pipe2(os.O_CLOEXEC)
        self._work = Thread(target=self._keep, daemon=True)
        self._work.start()

    def hand_over(self) -> tuple[socket.socket, list[Kept]]:
        """Stop; the listener, and the connections that have come. Call it once."""
        os.close(self._end)
        self._work.join()
        os.close(self._over)
        return self._listener, self._kept

    def close(self) -> None:
        """End all that has begun: nobody takes it over."""
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
