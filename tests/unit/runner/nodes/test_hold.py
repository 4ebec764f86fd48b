"""A node's group is frozen while it has to wait, and never when it has to end."""

from pathlib import Path

import pytest

from dora_systemd.decisions.cell.log_backlog import Marks
from dora_systemd.runner.nodes.hold import Hold


@pytest.fixture
def group(tmp_path: Path) -> Path:
    (tmp_path / "cgroup.freeze").write_text("0")
    return tmp_path


@pytest.fixture
def hold(group: Path) -> Hold:
    return Hold(group, Marks(hold=10, free=7))


def frozen(group: Path) -> str:
    return (group / "cgroup.freeze").read_text()


def test_held_between_the_marks(hold: Hold, group: Path) -> None:
    hold.look(9)
    assert frozen(group) == "0"
    for backlog in (10, 9, 100, 7):
        hold.look(backlog)
        assert frozen(group) == "1"
    hold.look(6)
    assert frozen(group) == "0"


def test_never_again_after_the_end(hold: Hold, group: Path) -> None:
    hold.look(10)
    hold.end()
    assert frozen(group) == "0"
    hold.look(100)
    assert frozen(group) == "0"


def test_not_while_it_is_exchanged(
    hold: Hold, group: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    hold.look(10)
    with hold.paused():
        now += 1
        hold.look(100)
        assert frozen(group) == "0"
    now += 1
    hold.look(100)
    assert frozen(group) == "1"


def test_an_end_meanwhile_is_an_end(hold: Hold, group: Path) -> None:
    with hold.paused():
        hold.end()
    hold.look(100)
    assert frozen(group) == "0"


def test_a_group_that_cannot_be_frozen(tmp_path: Path) -> None:
    hold = Hold(tmp_path / "gone", Marks(hold=10, free=7))
    hold.look(10)
    assert not hold.is_held
    hold.look(10)
    hold.end()
    assert not (tmp_path / "gone").exists()


def test_a_group_that_has_gone(hold: Hold, group: Path) -> None:
    hold.look(10)
    (group / "cgroup.freeze").unlink()
    hold.look(0)
    assert not hold.is_held
    hold.end()
    assert not (group / "cgroup.freeze").exists()
