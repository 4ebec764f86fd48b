"""Listens on the runner's socket. Imports only what loads quickly: see door.py."""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path


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
