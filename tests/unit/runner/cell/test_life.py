"""Whether a life is the first one of its unit."""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.runner.cell.life import begin_life, is_first_life, learn_first
from dora_systemd.runner.cell.pause import age
from dora_systemd.values import SECOND
from tests.unit.fakes.manager import options
from tests.unit.fakes.programs import make_program

POLICY = RestartPolicy("on-failure", delay=2 * SECOND)


@pytest.fixture
def unit_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That of a transient unit that starts right now, for the first time."""
    monkeypatch.setenv("FDSTORE", "4096")
    monkeypatch.delenv("LISTEN_FDNAMES", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "systemd/transient/dora-robot.service"
    path.parent.mkdir(parents=True)
    path.touch()
    os.utime(path, (time.time() - age() - 0.1,) * 2)
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


Learn = Callable[[str, int], tuple[bool, list[str]]]
ASKED = ["--user show --value --property=NRestarts dora-enabled.service"]


@pytest.fixture
def learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Learn:
    """Whether a life knows in the end that it is the first one, and what it has asked systemctl."""
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    asked = tmp_path / "asked"

    def learn(name: str, restarts: int) -> tuple[bool, list[str]]:
        asked.write_text("")
        make_program(tmp_path / "systemctl", f'echo "$@" >> {asked}; echo {restarts}')
        begun = begin_life(options(name, restart=POLICY), is_user=True)
        asyncio.run(learn_first(begun, name, is_user=True, seconds=0.0))
        return begun.is_first, asked.read_text().splitlines()

    return learn


@pytest.mark.usefixtures("unit_file")
def test_systemd_is_asked_once_for_what_only_it_knows(
    learned: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert learned("robot", 0) == (True, [])
    assert learned("enabled", 0) == (True, ASKED)
    assert learned("enabled", 1) == (False, ASKED)
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    assert learned("enabled", 0) == (False, [])


@pytest.mark.usefixtures("unit_file")
def test_no_thread_is_left_to_ask(learned: Learn, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_thread: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert learned("enabled", 0) == (False, [])
