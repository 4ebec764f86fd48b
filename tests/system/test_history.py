"""A history of a fixed seed, with every invariant; `make history` runs others, and more of them."""

import pytest

from tests.history.__main__ import run_history
from tests.history.checker import check
from tests.history.generator import generate

STEPS = 14


@pytest.mark.lab
@pytest.mark.parametrize("seed", [3])
def test_history(seed: int) -> None:
    complaints = check(run_history(generate(seed, STEPS)))
    assert not complaints, "\n".join(f"{one.invariant}: {one.text}" for one in complaints)
