"""A socket that listens, and a directory that every user can read."""

import socket
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

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


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory that every user can read.

    tmp_path is not: pytest makes its parent private, again at each start of another pytest.
    """
    with TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)
