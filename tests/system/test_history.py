"""Histories with every invariant: a seed, and what showed each defect that was found.

`make history` runs other seeds, and more of them.
"""

from collections.abc import Sequence

import pytest

from tests.history.__main__ import run_history
from tests.history.checker import check
from tests.history.found import FOUND
from tests.history.generator import generate
from tests.history.steps import Step

STEPS = 14

pytestmark = pytest.mark.lab


def check_history(steps: Sequence[Step]) -> None:
    """Carry out the steps, and check every invariant."""
    complaints = check(run_history(steps))
    assert not complaints, "\n".join(f"{one.invariant}: {one.text}" for one in complaints)


@pytest.mark.parametrize("seed", [3])
def test_history(seed: int) -> None:
    check_history(generate(seed, STEPS))


@pytest.mark.parametrize("what", FOUND)
def test_found(what: str) -> None:
    check_history(FOUND[what])
