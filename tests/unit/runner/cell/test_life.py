"""Whether a life is the first one of its unit."""

import asyncio
import os
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.runner.cell import life
from dora_systemd.runner.cell.life import begin_life, is_first_life, learn_first
from dora_systemd.values import SECOND
from tests.unit.fakes.manager import options

POLICY = RestartPolicy("on-failure", delay=2 * SECOND)


@pytest.fixture
def unit_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That of a transient unit that starts right now, for the first time."""
    monkeypatch.setenv("FDSTORE", "4096")
    monkeypatch.delenv("LISTEN_FDNAMES", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(life, "age", lambda: 0.5)
    path = tmp_path / "systemd/transient/dora-robot.service"
    path.parent.mkdir(parents=True)
    path.touch()
    os.utime(path, (path.stat().st_mtime - 0.6,) * 2)
    return path


@pytest.mark.usefixtures("unit_file")
def test_a_start() -> None:
    assert is_first_life(POLICY, "robot", is_user=True)
    assert not is_first_life(POLICY, "other", is_user=True)


@pytest.mark.parametrize("seconds", [-POLICY.unit_delay / SECOND, 60])
def test_a_life_may_have_been_before(unit_file: Path, seconds: float) -> None:
    """Or the clock was set."""
    os.utime(unit_file, (unit_file.stat().st_mtime + seconds,) * 2)
    assert not is_first_life(POLICY, "robot", is_user=True)
    assert is_first_life(RestartPolicy("no"), "robot", is_user=True)


@pytest.mark.usefixtures("unit_file")
def test_a_life_was_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    assert not is_first_life(POLICY, "robot", is_user=True)


def learned(monkeypatch: pytest.MonkeyPatch, name: str, restarts: int) -> tuple[bool, list[str]]:
    """Whether a life knows in the end that it is the first one, and what it has asked."""
    asked: list[str] = []

    def answer(what: str, of: str, is_user: bool, otherwise: int) -> int:
        del is_user, otherwise
        asked.append(f"{what} of {of}")
        return restarts

    monkeypatch.setattr(life, "asked", answer)
    monkeypatch.setattr(life, "ASK_SECONDS", 0.0)
    begun = begin_life(options(name, restart=POLICY), is_user=True)
    asyncio.run(learn_first(begun, name, is_user=True))
    return begun.is_first, asked


@pytest.mark.usefixtures("unit_file")
def test_systemd_is_asked_once_for_what_only_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    assert learned(monkeypatch, "robot", 0) == (True, [])
    assert learned(monkeypatch, "enabled", 0) == (True, ["NRestarts of enabled"])
    assert learned(monkeypatch, "enabled", 1) == (False, ["NRestarts of enabled"])
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    assert learned(monkeypatch, "enabled", 0) == (False, [])


@pytest.mark.usefixtures("unit_file")
def test_no_thread_is_left_to_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_call: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(life, "beside", refuse)
    assert learned(monkeypatch, "enabled", 0) == (False, [])
