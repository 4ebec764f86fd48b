"""What a rollback does to a dataflow without a release before the present one, or disabled."""

from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.manifest import Manifest
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.rollback import roll_back
from dora_systemd.verbs.releases.trial import read_standing
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import NEW, OLD, UNIT, release_options, store, text_of

__all__ = ["store"]


@pytest.fixture(autouse=True)
def _known(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FakeJournal(monkeypatch, tmp_path)
    store.release(NEW).rmdir()
    for release in (OLD, NEW):
        draft = Draft(store)
        draft.publish(Manifest(release, "robot", "u", "dataflow.yml", "/srv", "", "", 1), None)
        store.write_unit(release, text_of(release))


@pytest.mark.parametrize("active", ["active", "failed"])
def test_a_first_trial_that_was_killed_ends(
    manager: FakeManager, scope: Scope, active: str
) -> None:
    path = read_standing(manager, scope, UNIT).path
    path.parent.mkdir(parents=True)
    path.write_text(text_of(NEW))
    manager.add(release_options(NEW), active, Transient=False, FragmentPath=str(path))
    done = roll_back(manager, scope, "robot", None, 0, print)
    assert (done.release, done.former) == ("", NEW)
    assert not path.exists()
    assert ("StopUnit", UNIT) in manager.calls
    assert "RestartUnit" not in [call[0] for call in manager.calls]


def test_what_is_disabled_stays_so(manager: FakeManager, scope: Scope) -> None:
    manager.add(release_options(NEW), "active", Transient=False)
    roll_back(manager, scope, "robot", OLD, 0, print)
    standing = read_standing(manager, scope, UNIT)
    assert (standing.current, standing.boot.is_enabled) == (OLD, False)


@pytest.mark.parametrize("current", [OLD, NEW])
@pytest.mark.parametrize("damage", ["other", "", None])
def test_a_damaged_release_is_refused(
    manager: FakeManager, scope: Scope, store: Store, damage: str | None, current: str
) -> None:
    """Its trial need not notice that a model has lost its weights.

    If it is the present one, the dataflow must keep running: nothing else could take its place.
    """
    manager.add(release_options(NEW), "active", Transient=False)
    files = {name: Draft(store).write(name, [b"model"], False) for name in ("a.onnx", "b.onnx")}
    tree = store.tree(OLD)
    tree.chmod(0o700)
    for name in files:
        (tree / name).write_bytes(b"model")
    store.write_manifest(replace(store.manifest(OLD), files=files))
    for release in (OLD, NEW, current):
        roll_back(manager, scope, "robot", release, 0, print)
    if damage is None:
        (tree / "b.onnx").unlink()
    else:
        (tree / "b.onnx").write_text(damage)
    before = len(manager.calls)
    with pytest.raises(DoraSystemdError, match=r"it is damaged: b\.onnx changed") as caught:
        roll_back(manager, scope, "robot", OLD, 0, print)
    assert caught.value.code == ExitCode.BAD_INPUT
    assert manager.calls[before:] == []


def test_a_release_whose_user_is_gone_is_refused(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    """Else the dataflow would be down, and the release marked as failed, which it is not."""
    manager.add(release_options(NEW), "active", Transient=False)
    store.write_unit(OLD, text_of(OLD, "gone"))
    with pytest.raises(DoraSystemdError, match="there is no user gone") as caught:
        roll_back(manager, scope, "robot", OLD, 0, print)
    assert caught.value.code == ExitCode.BAD_INPUT
    assert manager.calls == []


def test_a_release_without_its_files_is_named(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    manager.add(release_options(NEW), "active", Transient=False)
    store.release(OLD).chmod(0o700)
    store.tree(OLD).rename(store.release(OLD) / "elsewhere")
    with pytest.raises(DoraSystemdError, match=f"release {OLD} of robot: its files are gone"):
        roll_back(manager, scope, "robot", OLD, 0, print)
