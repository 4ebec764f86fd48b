"""What tests of the logs of nodes have in common."""

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    """A loop that runs when a test says so."""
    loop = asyncio.new_event_loop()
    yield loop
    loop.close()


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    """The output pipe of a node."""
    path = tmp_path / "a.out"
    os.mkfifo(path)
    return path
