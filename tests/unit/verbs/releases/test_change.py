"""Signals while a release changes, with the real gate."""

import os
import signal
from collections.abc import Sequence

import pytest

from dora_systemd.adapters.releases.store import Store
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.inhibit.guard import IfInhibited
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.trial import read_standing
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import (
    NEW,
    OLD,
    UNIT,
    deployed,
    release_options,
    store,
    text_of,
)

__all__ = ["store"]


class Interrupted(FakeManager):
    """Sends this process a signal at a moment of the change.

    moment: "trial", "commit" or "way back". state: of the unit after the first restart.
    """

    def __init__(self, etc: FakeManager, moment: str, state: str) -> None:
        super().__init__()
        self.etc, self.moment, self.state = etc.etc, moment, state

    def queue_job(self, method: str, unit: str) -> str:
        is_back = (method, unit) in self.calls
        job = super().queue_job(method, unit)
        self.units[unit]["ActiveState"] = "active" if is_back else self.state
        self._come("way back" if is_back else "trial")
        return job

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        if self.calls:
            self._come("commit")
        return super().enable_unit_files(names)

    def _come(self, moment: str) -> None:
        if moment == self.moment:
            for one in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
                os.kill(os.getpid(), one)


@pytest.mark.parametrize(
    ("moment", "state", "reason"),
    [
        ("trial", "active", "the command was interrupted"),
        ("way back", "failed", "exit code 0"),
        ("commit", "active", ""),
    ],
)
def test_signals(
    manager: FakeManager, scope: Scope, store: Store, moment: str, state: str, reason: str
) -> None:
    """The trial ends at once; neither a commit nor the way back stops in the middle."""
    interrupted = Interrupted(manager, moment, state)
    deployed(interrupted)
    interrupted.hold(UNIT)  # as a unit with a file
    interrupted.calls.clear()
    change = Change(
        *(NEW, text_of(NEW), release_options(NEW), 0, True, "deploy", IfInhibited.REFUSE),
        by="doractl deploy",
    )
    before = read_standing(interrupted, scope, UNIT)
    error: BaseException | None = None
    try:
        change_release(interrupted, scope, store, before, change, lambda _: None)
    except (DoraSystemdError, KeyboardInterrupt) as raised:
        error = raised
    after = read_standing(interrupted, scope, UNIT)
    assert not after.path.exists()
    if not reason:
        assert (error, after.current) == (None, NEW)
        return
    assert isinstance(error, DoraSystemdError)
    assert error.code is ExitCode.ROLLED_BACK
    assert error.message.endswith(reason)
    assert (after.current, interrupted.units[UNIT]["ActiveState"]) == (OLD, "active")
    assert f"{OLD} runs again" in error.hint
