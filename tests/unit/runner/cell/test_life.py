"""Whether a life is the first one of its unit."""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.runner.cell.life import (
    Life,
    begin_life,
    is_first_life,
    is_transient,
    learn_first,
)
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


@pytest.mark.parametrize(
    ("after", "is_first"),
    [
        (-POLICY.unit_delay / SECOND + 0.05, True),
        (-POLICY.unit_delay / SECOND - 0.05, False),
        (-0.02, True),
        (0.05, False),
    ],
)
def test_only_a_start_that_was_just_queued_is_the_first(
    unit_file: Path, after: float, is_first: bool
) -> None:
    """systemd writes the file then, before the process begins; a restart comes after its delay."""
    os.utime(unit_file, (time.time() - age() + after,) * 2)
    assert is_first_life(POLICY, "robot", is_user=True) == is_first


def test_a_life(monkeypatch: pytest.MonkeyPatch, unit_file: Path) -> None:
    begun = begin_life(options("robot", restart=POLICY), is_user=True)
    assert (begun.uuid, begun.is_first, begun.may_be_first) == (options().uuid, True, False)
    assert begun.up_us == 0
    begun.become_up()
    first = begun.up_us
    assert 0 < first <= time.monotonic_ns() // 1000
    begun.become_up()
    assert begun.up_us == first
    unit_file.unlink()
    later = begin_life(options("robot", restart=POLICY), is_user=True)
    assert (later.is_first, later.may_be_first) == (False, True), "systemd knows"
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    later = begin_life(options("robot", restart=POLICY), is_user=True)
    assert (later.is_first, later.may_be_first) == (False, False)
    plain = Life("uuid")
    assert (plain.is_first, plain.may_be_first) == (False, False)


def test_whose_unit_is_transient(unit_file: Path) -> None:
    assert is_transient("robot", is_user=True)
    assert not is_transient("other", is_user=True)
    assert not is_transient("robot", is_user=False), "root's are in /run"
    unit_file.unlink()
    assert not is_transient("robot", is_user=True)
