"""Releases of the dataflow of a test, and none of them afterwards."""

from collections.abc import Iterator

import pytest

from tests.system.cells import Cell
from tests.system.releases import Releases


@pytest.fixture
def releases(cell: Cell) -> Iterator[Releases]:
    found = Releases(cell)
    yield found
    found.end()
