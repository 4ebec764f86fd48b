"""What doractl forget removes, and what it refuses."""

from pathlib import Path

import pytest

from dora_systemd.decisions.releases.past import REMOVED
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.releases.forget import Kept, find_kept, forget, remove_releases
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID
from tests.unit.verbs.releases.test_past import A, B, C, Robot, robot, scope
from tests.unit.verbs.releases.test_trial import UNIT

__all__ = ["robot", "scope"]


def end(robot: Robot) -> None:
    """Stop and disable it."""
    robot.unit_file.unlink(missing_ok=True)
    robot.manager.units.pop(UNIT, None)


def test_all_that_is_kept(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    robot.fail(C)
    (robot.store.path / ".new-0123").mkdir()
    for release in (A, B, C):  # as it is in user scope
        robot.store.tree(release).chmod(0o555)
    end(robot)
    kept = find_kept(robot.manager, robot.scope, "robot")
    assert kept == Kept("robot", "u", (A, B, C))
    forget(robot.manager, robot.scope, kept)
    assert not robot.store.path.exists()
    assert not robot.store.lock.exists()


def test_what_runs_or_is_enabled_stays(robot: Robot) -> None:
    robot.run(A)
    wanted = robot.unit_file.parent / "default.target.wants" / UNIT
    wanted.parent.mkdir()
    for reason, hint in (
        ("it is running", "doractl stop robot"),
        ("its unit file is kept", "doractl disable"),
        ("it is enabled", "doractl disable"),
    ):
        if reason == "it is enabled":
            wanted.symlink_to(robot.unit_file)
        with pytest.raises(DoraSystemdError, match=f"cannot forget robot: {reason}") as caught:
            find_kept(robot.manager, robot.scope, "robot")
        assert hint in caught.value.hint
        assert caught.value.code == ExitCode.NAME_IN_USE
        robot.manager.units[UNIT]["ActiveState"] = "inactive"
    assert [one.id for one in robot.store.known()] == [A]


def test_one_that_begins_to_run_meanwhile_stays(robot: Robot) -> None:
    robot.run(A)
    end(robot)
    kept = find_kept(robot.manager, robot.scope, "robot")
    robot.run(A)
    with pytest.raises(DoraSystemdError, match="it is running"):
        forget(robot.manager, robot.scope, kept)
    assert robot.store.known()


def test_one_release(robot: Robot) -> None:
    robot.run(A)
    robot.run(B)
    robot.run(C)
    for release, reason in ((C, "every start runs"), ("20200101T000000", "has no release")):
        with pytest.raises(DoraSystemdError, match=reason):
            list(remove_releases(robot.manager, robot.scope, "robot", (B, release)))
    assert len(robot.store.known()) == 3, "nothing was removed"
    done = list(remove_releases(robot.manager, robot.scope, "robot", (B, B)))
    assert [release for _, release in done] == [B]
    assert [one.id for one in robot.store.known()] == [A, C]
    assert robot.past[-1] == (B, C, REMOVED)
    # What ran before is the one before that.
    robot.run(A, "doractl rollback")
    assert robot.states == ["current", "rolled-back"]


def test_what_only_the_journal_knows(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    journal = FakeJournal(monkeypatch, tmp_path)
    journal.write(life_record("dataflow-stopped", 17, "gone", scope=robot.scope))
    assert find_kept(robot.manager, robot.scope, "gone") == Kept("gone", UUID, ())


def test_what_nobody_knows(robot: Robot) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find_kept(robot.manager, robot.scope, "other")
    assert caught.value.code == ExitCode.NOT_FOUND
