"""What a killed deploy has left is named and removed, and nothing else."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.past import REPLACED, Switch
from dora_systemd.decisions.views.findings import State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases import listing as module
from dora_systemd.verbs.releases.build import clean
from dora_systemd.verbs.releases.trial import read_standing, remains
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import NEW, OLD, UNIT, deployed, etc, store

__all__ = ["store"]


def leave(path: Path, age: float) -> Path:
    """A file as of write_atomic(), so many seconds old."""
    left = path.with_name(f".{path.name}.0a1b2c3d")
    left.parent.mkdir(parents=True, exist_ok=True)
    left.touch()
    at = left.stat().st_mtime - age
    os.utime(left, (at, at))
    return left


def test_what_is_left(manager: FakeManager, scope: Scope, store: Store) -> None:
    deployed(manager)
    store.release(OLD).mkdir()  # without a unit file, but it is what runs
    (store.path / "notes").touch()
    draft = store.path / ".new-0a1b2c3d4e5f"
    draft.mkdir()
    standing = read_standing(manager, scope, UNIT)
    own, trial = leave(etc(manager), 100), leave(standing.path, 100)
    young, other = leave(etc(manager).with_name("x.service"), 100), etc(manager).with_suffix(".d")
    other.mkdir()
    edited = etc(manager).with_name(f".{etc(manager).name}.swp")
    edited.touch()
    os.utime(edited, (0, 0))
    assert set(remains(store, standing)) == {draft, store.release(NEW), own, trial}
    told = [one.text for one in module.judge_releases(manager, scope)]
    assert [f"{one} is the rest of a deploy that was killed" for one in (draft, own)] == [
        one for one in told if str(draft) in one or str(own) in one
    ]
    clean(manager, store, standing)
    assert list(remains(store, standing)) == []
    assert young.exists()
    assert edited.exists(), "an administrator edits the unit file"
    assert sorted(path.name for path in store.path.iterdir()) == [OLD, "notes"]


def test_what_is_being_written_stays(manager: FakeManager, scope: Scope, store: Store) -> None:
    deployed(manager)
    store.write_unit(NEW, "")
    left = leave(etc(manager), 1)
    clean(manager, store, read_standing(manager, scope, UNIT))
    assert left.exists()


def test_a_foreign_unit_hides_no_other_dataflow(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    other = store.path.with_name("other")
    (other / OLD).mkdir(parents=True)
    foreign = etc(manager).with_name("dora-other.service")
    foreign.parent.mkdir(parents=True)
    foreign.write_text("[Service]\nExecStart=/bin/true\n")
    (store.path / ".new-0a1b2c3d4e5f").mkdir()
    rows = module.read_releases(manager, scope, ["other", "robot"])
    assert (rows[0].name, rows[0].id, rows[0].state) == ("other", OLD, "unknown")
    assert {row.name for row in rows} == {"other", "robot"}
    with pytest.raises(DoraSystemdError, match="is not doractl's"):
        module.read_releases(manager, scope, ["other"])
    told = [one.text for one in module.judge_releases(manager, scope)]
    assert any("is not doractl's" in one for one in told)
    assert any(".new-0a1b2c3d4e5f is the rest of" in one for one in told)


def test_damaged_lines_of_the_history_are_reported(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    """A rollback could take another release than the one that ran."""
    deployed(manager)
    store.record(Switch(1, OLD, NEW, REPLACED))
    history = store.path / "history"
    assert not [one for one in module.judge_releases(manager, scope) if " damaged line" in one.text]
    history.write_bytes(history.read_bytes() + b'{"from": \r\0\nnothing\n{"power": "cu')
    (found,) = [one for one in module.judge_releases(manager, scope) if " damaged line" in one.text]
    assert found.text == f"{history} has 2 damaged lines: rollback ignores them"
    assert found.state is State.WARNING
    assert len(store.history()) == 1
