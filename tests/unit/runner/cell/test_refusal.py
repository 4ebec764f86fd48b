"""The command line of a runner that another version has started."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.options import format_runner_argv, known_options
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.refusal import read_options
from tests.unit.fakes.manager import options


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as server:
        server.bind(str(tmp_path / "socket"))
        yield server


def test_an_option_that_this_version_does_not_know(journal: socket.socket) -> None:
    """It is recorded under the name that this version does know."""
    argv = ["--new=1", *format_runner_argv(options())]
    with pytest.raises(DoraSystemdError, match="unknown argument '--new=1'"):
        read_options(argv, journal.getsockname())
    record = journal.recv(65536).decode().splitlines()
    assert "DORA_CAUSE=other-version" in record
    assert "DORA_DATAFLOW_NAME=robot" in record
    assert known_options(argv) == options()


def test_others(journal: socket.socket) -> None:
    assert read_options(format_runner_argv(options()), journal.getsockname()) == options()
    with pytest.raises(DoraSystemdError, match="no absolute path"):
        read_options([], journal.getsockname())
    with pytest.raises(BlockingIOError):
        journal.recv(1)
