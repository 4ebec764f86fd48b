"""A listener, for tests of who is at the other end."""

import socket
from collections.abc import Iterator

import pytest


@pytest.fixture
def tcp_listener(host: str) -> Iterator[socket.socket]:
    """A socket that listens on a port of `host`, which the test names as a parameter."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as one:
        try:
            one.bind((host, 0))
        except OSError:
            pytest.skip(f"no {host} on this machine")
        one.listen()
        yield one
