"""The IP addresses of this machine, and the TCP ports of 127.0.0.1."""

import contextlib
import errno
import socket
import time

_HOST = "127.0.0.1"
_RETRY_SECONDS = 0.05
_CHUNK = 65536
_ANY_PORT = 9
"""The port only serves to choose a route: nothing is sent there."""


def source_address(address: str, wanted: str = "") -> str:
    """The address of this machine from which it reaches another one, or "", see ip-route(8).

    wanted: it has to be this one, unless "".
    """
    with contextlib.suppress(OSError), _socket(address, socket.SOCK_DGRAM) as one:
        if wanted:
            one.bind((wanted, 0))
        one.connect((address, _ANY_PORT))
        return str(one.getsockname()[0])
    return ""


def listen_error(address: str, port: int = 0) -> int:
    """The errno of listening on a TCP port of an address, 0 for any port; 0 if that works."""
    with _socket(address, socket.SOCK_STREAM) as trial:
        # As systemd and zenoh do: remains of closed connections do not block the port.
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address, port))
            trial.listen(1)
        except OSError as error:
            return error.errno or errno.EINVAL
    return 0


def is_own(address: str) -> bool:
    """Whether this machine has the address now."""
    return listen_error(address) != errno.EADDRNOTAVAIL


def _socket(address: str, kind: socket.SocketKind) -> socket.socket:
    return socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, kind)


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
