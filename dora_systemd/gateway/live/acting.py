"""Actions that take their time: a page may disconnect meanwhile, and the gateway may be stopped.

They run in threads, which no signal reaches.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from dora_systemd.errors import DoraSystemdError


class Action:
    """One that is under way. must_end: the gateway is about to end, and it has not been told."""

    def __init__(self) -> None:
        self.must_end = False

    def go_on(self, _step: object = None) -> None:
        """Raise DoraSystemdError, once, if the gateway is about to end."""
        if self.must_end:
            self.must_end = False  # the way back has to be gone to its end
            raise DoraSystemdError("the gateway was stopped")


_actions: set[Action] = set()


@contextmanager
def acting() -> Iterator[Action]:
    """An action during which the gateway does not rest."""
    action = Action()
    _actions.add(action)
    try:
        yield action
    finally:
        _actions.discard(action)


def is_acting() -> bool:
    """Whether any action is under way."""
    return bool(_actions)


def end_actions() -> None:
    """Have all of them end soon."""
    for action in list(_actions):
        action.must_end = True
