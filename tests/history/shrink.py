"""Makes a history that breaks an invariant shorter, as long as it breaks it. Pure.

Delta debugging: leave out a part of the steps, keep what still fails, halve the parts.
"""

from collections.abc import Callable, Iterator, Sequence

from tests.history.steps import LOOK, Step

Fails = Callable[[list[Step]], bool]


def shrink(steps: Sequence[Step], fails: Fails, most: int = 40) -> list[Step]:
    """The shortest steps found for which `fails` still holds, by at most `most` questions."""
    left, asked, size = list(steps), 0, max(len(steps) // 2, 1)
    while asked < most:
        for shorter in _without(left, size):
            asked += 1
            if fails(shorter):
                left = shorter
                break
            if asked >= most:
                return left
        else:
            if size == 1:
                return left
            size = max(size // 2, 1)
    return left


def _without(steps: list[Step], size: int) -> Iterator[list[Step]]:
    for place in range(0, len(steps), size):
        rest = steps[:place] + steps[place + size :]
        if any(step.what != LOOK for step in rest):
            whole = rest if rest[-1].what == LOOK else [*rest, Step(LOOK)]
            if len(whole) < len(steps):
                yield whole
