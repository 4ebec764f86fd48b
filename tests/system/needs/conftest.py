"""A place for devices that are plugged in and unplugged."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell
from tests.system.needs.scene import place_of


@pytest.fixture
def place(cell: Cell) -> Iterator[Path]:
    place = place_of(cell)
    yield place
    shutil.rmtree(place)
