"""A place for devices that are plugged in and unplugged."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell
from tests.system.needs.scene import place_of


@pytest.fixture(params=["/run", "/dev"])
def place(cell: Cell, request: pytest.FixtureRequest) -> Iterator[Path]:
    """In /dev nothing is polled, because the kernel reports all changes there."""
    place = place_of(cell, request.param)
    yield place
    shutil.rmtree(place)
