"""Actions that take their time: a page may disconnect meanwhile, and the gateway may be stopped.

They run in threads, which no signal reaches.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dora_systemd.adapters.host.notify import extend_timeout
from dora_systemd.errors import DoraSystemdError
from dora_systemd.values import SECOND

_LONGER = 30 * SECOND
"""µs from each step of an action on that systemd gives the gateway to end, if it has to. Without
that it would kill the gateway while a dataflow with a long grace duration stops."""


class Action:
    """An action under way. must_end: the gateway is about to end, and the action does not know."""

    def __init__(self, all_of_them: "Actions") -> None:
        self.must_end = False
        self._all = all_of_them

    def go_on(self, _step: object = None) -> None:
        """Raise DoraSystemdError, once, if the gateway is about to end."""
        self._all.hold_on()
        if self.must_end:
            self.must_end = False  # the way back has to be gone to its end
            raise _stopped()


class Actions:
    """All actions of a gateway. extend: tells systemd that it needs so many µs more to end."""

    def __init__(self, extend: Callable[[int], object] = extend_timeout) -> None:
        self._extend = extend
        self._under_way: set[Action] = set()
        self._ending = threading.Event()

    @contextmanager
    def acting(self) -> Iterator[Action]:
        """An action during which the gateway does not rest.

        Raises DoraSystemdError if the gateway is about to end: it begins no more of them.
        """
        action = Action(self)
        self._under_way.add(action)
        try:
            if self._ending.is_set():
                raise _stopped()
            yield action
        finally:
            self._under_way.discard(action)

    @property
    def is_acting(self) -> bool:
        """Whether any action is under way."""
        return bool(self._under_way)

    def hold_on(self) -> None:
        """Keep systemd from killing a gateway that ends while an action goes on."""
        if self._ending.is_set():
            self._extend(_LONGER)

    def end(self) -> None:
        """Have all of them end soon."""
        self._ending.set()  # first: one that begins now is in the set, or sees this
        for action in list(self._under_way):
            action.must_end = True


ACTIONS = Actions()
"""Those of this process."""


def _stopped() -> DoraSystemdError:
    return DoraSystemdError("the gateway was stopped", "it starts again with the next connection")
