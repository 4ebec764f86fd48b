"""TCP ports of 127.0.0.1: whether one is free, and whether the gateway answers."""

import contextlib
import socket
import time

from dora_systemd.adapters.host.addresses import listen_error

_HOST = "127.0.0.1"
_RETRY_SECONDS = 0.05
_CHUNK = 65536


def port_error(port: int) -> int:
    """The errno of listening on the port; 0 if it is free."""
    return listen_error(_HOST, port)


def answers_health(port: int, seconds: float) -> bool:
    """Whether GET /health returns 200 within `seconds`."""
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        with contextlib.suppress(OSError):
            if _ask(port, left).startswith(b"HTTP/1.1 200 "):
                return True
        time.sleep(_RETRY_SECONDS)
    return False


def _ask(port: int, seconds: float) -> bytes:
    with socket.create_connection((_HOST, port), timeout=seconds) as connection:
        connection.sendall(f"GET /health HTTP/1.1\r\nHost: {_HOST}:{port}\r\n\r\n".encode())
        return connection.recv(_CHUNK)
