"""What the child of a doractl that was killed does, before and after the commit."""

import socket
from functools import partial

import pytest

from dora_systemd.adapters.releases.store import Store
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.releases import change as module
from dora_systemd.verbs.releases.change import Change
from dora_systemd.verbs.releases.trial import Standing, begin_trial, read_life, read_standing
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import (
    NEW,
    OLD,
    UNIT,
    deployed,
    etc,
    release_options,
    store,
    text_of,
)

__all__ = ["store"]

CHANGE = Change(
    NEW, text_of(NEW), release_options(NEW), 0, True, "deploy", IfInhibited.REFUSE, "doractl deploy"
)


@pytest.fixture
def end(manager: FakeManager, scope: Scope, store: Store) -> "partial[None]":
    """The end of a change that has begun with the old release."""
    deployed(manager)
    standing = read_standing(manager, scope, UNIT)
    begin_trial(manager, standing, text_of(NEW))
    mark = module._Mark(store, NEW)
    life = read_life(manager, UNIT)
    return partial(module.end_killed, manager, scope, standing, CHANGE, life, mark)


def now(manager: FakeManager, scope: Scope) -> Standing:
    standing = read_standing(manager, scope, UNIT)
    assert not standing.path.exists()
    return standing


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The events that are written."""
    notes: list[bytes] = []
    monkeypatch.setattr(socket.socket, "sendto", lambda _, data, *__: notes.append(data))
    return notes


@pytest.mark.parametrize("state", [{"Job": (7, "/org")}, {"InvocationID": b"\x01"}])
def test_before_the_commit(
    manager: FakeManager,
    scope: Scope,
    store: Store,
    end: "partial[None]",
    state: dict[str, object],
) -> None:
    manager.units[UNIT] |= state
    store.prove(NEW)
    end()
    assert [one.is_proved for one in store.known()] == [False]
    assert now(manager, scope).current == OLD
    assert ("RestartUnit", UNIT) in manager.calls
    (switch,) = store.history()
    assert (switch.former, switch.release, switch.how) == (NEW, OLD, "interrupted")
    assert switch.reason == "the command that tried it was killed", "which is no fault of it"


def test_before_systemd_was_told(
    manager: FakeManager, scope: Scope, end: "partial[None]", notes: list[bytes]
) -> None:
    """What runs has not been touched, so it goes on; and nobody tells of a trial."""
    end()
    assert now(manager, scope).current == OLD
    assert "reload" in [call[0] for call in manager.calls]
    assert "RestartUnit" not in [call[0] for call in manager.calls]
    assert notes == []


def test_while_systemd_was_told(
    manager: FakeManager, end: "partial[None]", monkeypatch: pytest.MonkeyPatch
) -> None:
    """The restart comes out of the queue while the trial ends."""

    def reload() -> None:
        manager.units[UNIT]["Job"] = (7, "/org")

    monkeypatch.setattr(manager, "reload", reload)
    end()
    assert ("RestartUnit", UNIT) in manager.calls


def test_after_the_commit(
    manager: FakeManager, scope: Scope, store: Store, end: "partial[None]"
) -> None:
    """Nothing is started again, and the link is there that it had not made yet."""
    manager.disable_unit_files([UNIT])
    etc(manager).write_text(text_of(NEW))
    end()
    standing = now(manager, scope)
    assert (standing.current, standing.boot.is_enabled) == (NEW, True)
    (switch,) = store.history()
    assert (switch.former, switch.release, switch.how) == (OLD, NEW, "replaced")
    assert switch.by.endswith(" (doractl deploy)")
    assert "RestartUnit" not in [call[0] for call in manager.calls]
