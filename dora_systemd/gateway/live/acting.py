"""Actions that take their time: a page may disconnect meanwhile, and the gateway may be stopped.

They run in threads, which no signal reaches.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dora_systemd.adapters.host.notify import extend_timeout
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import SECOND

_LONGER = 30 * SECOND
"""µs from each step of an action on that systemd gives the gateway to end, if it has to. Without
that it would kill the gateway while a dataflow with a long grace duration stops."""


class Action:
    """An action under way. must_end: the gateway is about to end, and the action does not know."""

    def __init__(self) -> None:
        self.must_end = False

    def go_on(self, _step: object = None) -> None:
        """Raise DoraSystemdError, once, if the gateway is about to end."""
        if _ending.is_set():
            extend_timeout(_LONGER)
        if self.must_end:
            self.must_end = False  # the way back has to be gone to its end
            raise _stopped()


_actions: set[Action] = set()
_ending = threading.Event()


@contextmanager
def acting() -> Iterator[Action]:
    """An action during which the gateway does not rest.

    Raises DoraSystemdError if the gateway is about to end: it begins no more of them.
    """
    action = Action()
    _actions.add(action)
    try:
        if _ending.is_set():
            raise _stopped()
        yield action
    finally:
        _actions.discard(action)


def is_acting() -> bool:
    """Whether any action is under way."""
    return bool(_actions)


def end_actions() -> None:
    """Have all of them end soon."""
    _ending.set()  # first: one that begins now is in the set, or sees this
    for action in list(_actions):
        action.must_end = True


def _stopped() -> DoraSystemdError:
    return DoraSystemdError("the gateway was stopped", "it starts again with the next connection")
