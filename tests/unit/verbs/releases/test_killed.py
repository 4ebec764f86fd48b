"""What the child of a doractl that was killed does, before and after the commit."""

from functools import partial

import pytest

from dora_systemd.scope import Scope
from dora_systemd.verbs.inhibit.guard import IfInhibited
from dora_systemd.verbs.releases import change as module
from dora_systemd.verbs.releases.change import Change
from dora_systemd.verbs.releases.trial import Standing, begin_trial, read_standing
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import (
    NEW,
    OLD,
    UNIT,
    deployed,
    etc,
    release_options,
    text_of,
)

CHANGE = Change(
    NEW, text_of(NEW), release_options(NEW), 0, True, "deploy", IfInhibited.REFUSE, "doractl deploy"
)


@pytest.fixture
def end(manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch) -> "partial[None]":
    """The end of a change that has begun with the old release."""
    monkeypatch.setattr(module, "Bus", lambda _: manager)
    deployed(manager)
    standing = read_standing(manager, scope, UNIT)
    begin_trial(manager, standing, text_of(NEW))
    return partial(module._end_killed, scope, standing, CHANGE)


def now(manager: FakeManager, scope: Scope) -> Standing:
    standing = read_standing(manager, scope, UNIT)
    assert not standing.path.exists()
    return standing


def test_before_the_commit(manager: FakeManager, scope: Scope, end: "partial[None]") -> None:
    end()
    assert now(manager, scope).current == OLD
    assert ("RestartUnit", UNIT) in manager.calls


def test_after_the_commit(manager: FakeManager, scope: Scope, end: "partial[None]") -> None:
    """Nothing is started again, and the link is there that it had not made yet."""
    manager.disable_unit_files([UNIT])
    etc(manager).write_text(text_of(NEW))
    end()
    standing = now(manager, scope)
    assert (standing.current, standing.boot.is_enabled) == (NEW, True)
    assert "RestartUnit" not in [call[0] for call in manager.calls]
