"""doractl destroy, with a clock of its own."""

import os
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.gateway.place import SERVICE_UNIT, SOCKET_UNIT
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.names import SLICE
from dora_systemd.verbs.destroy import (
    processes_left,
    stop_all,
    stop_gateway,
    stop_gateway_of,
    stop_slice,
)
from dora_systemd.verbs.up import PORT_FILE
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.manager import FakeManager, ScopeIn, options

ROBOT = "dora-robot.service"


class Systemd(FakeManager):
    """Units that go down so many looks after they were told to, and after SIGKILL at once."""

    def __init__(self, etc: Path) -> None:
        super().__init__()
        self.etc = etc
        self.looks: dict[str, int] = {}
        self.immortal: set[str] = set()
        self.gone: set[str] = set()

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        if unit in self.looks and "ActiveState" in names:
            self.looks[unit] -= 1
            if self.looks[unit] < 0:
                self.units[unit]["ActiveState"] = "inactive"
        return super().read(unit, names)

    def queue_job(self, method: str, unit: str) -> str:
        if unit in self.gone:
            del self.units[unit]
            return ""
        self.looks.setdefault(unit, 2)
        return super().queue_job(method, unit)

    def kill(self, unit: str, signal: int, whom: str = "all") -> None:
        super().kill(unit, signal, whom)
        if unit in self.units and unit not in self.immortal:
            self.looks.pop(unit, None)
            self.units[unit]["ActiveState"] = "failed"


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Systemd:
    monkeypatch.setattr("time.sleep", lambda _seconds: None)
    return Systemd(tmp_path / "etc")


def destroy(systemd: Systemd, scope: ScopeIn, want_kill: bool = False) -> list[Outcome]:
    return list(stop_all(systemd, scope, want_kill, count(1.0).__next__))


@pytest.mark.parametrize("active", ["active", "activating", "deactivating", "reloading"])
def test_everything_that_is_up_is_stopped(active: str, systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options("a"), active=active, TimeoutStopUSec=17_000_000)
    systemd.add(options("b"), active="failed")
    systemd.add(options("robot"), TimeoutStopUSec=17_000_000)
    assert {one.subject.name for one in destroy(systemd, scope)} == {"a", "robot"}
    assert systemd.calls == [("StopUnit", "dora-a.service"), ("StopUnit", ROBOT)]


def test_one_that_ends_by_itself_meanwhile(systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options("a"), TimeoutStopUSec=17_000_000)
    systemd.add(options("robot"), TimeoutStopUSec=17_000_000)
    systemd.gone = {"dora-a.service"}
    assert {one.subject.name for one in destroy(systemd, scope)} == {"a", "robot"}
    assert systemd.calls == [("StopUnit", ROBOT)]


def test_what_does_not_end_is_killed(systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options(), TimeoutStopUSec=3_000_000)
    systemd.looks[ROBOT] = 1000
    assert [one.text for one in destroy(systemd, scope)] == ["  ✓ robot stopped (killed)"]
    stop = ("StopUnit", ROBOT)
    assert systemd.calls == [stop, stop, ("kill", ROBOT, 9, "all"), ("reset", ROBOT)]


@pytest.mark.parametrize("timeout", [2**64 - 1, 5_000_000])
def test_there_is_an_end_to_it(timeout: int, systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options(), TimeoutStopUSec=timeout)
    systemd.looks[ROBOT] = 1000
    systemd.immortal.add(ROBOT)
    (ended,) = destroy(systemd, scope)
    assert ended.problem == f"cannot stop {ROBOT}: it is active although it was killed"


def test_by_force(systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options(), TimeoutStopUSec=3_000_000)
    (killed,) = destroy(systemd, scope, want_kill=True)
    assert (killed.text, killed.problem) == ("  ✓ robot stopped (killed)", "")
    assert systemd.calls[:2] == [("StopUnit", ROBOT), ("kill", ROBOT, 9, "all")]


def test_what_somebody_starts_meanwhile_is_stopped(systemd: Systemd, scope: ScopeIn) -> None:
    systemd.add(options("a"), TimeoutStopUSec=3_000_000)
    names = []
    for ended in stop_all(systemd, scope, False, count(1.0).__next__):
        names.append(ended.subject.name)
        if len(names) == 1:
            systemd.add(options("late"), TimeoutStopUSec=3_000_000)
    assert names == ["a", "late"]


def test_the_gateway(systemd: Systemd, scope: ScopeIn) -> None:
    assert not stop_gateway(systemd, scope)
    assert systemd.calls == []
    systemd.units[SOCKET_UNIT] = {"LoadState": "loaded", "ActiveState": "active"}
    systemd.units[SERVICE_UNIT] = {"LoadState": "loaded", "ActiveState": "inactive"}
    runtime = scope.root / "systemd/system"
    port = runtime / PORT_FILE
    port.parent.mkdir(parents=True)
    port.write_text("x")
    (runtime / "dora-other.service").write_text("x")
    assert stop_gateway(systemd, scope)
    assert systemd.calls == [("StopUnit", SOCKET_UNIT), ("reload",)]
    assert [path.name for path in runtime.iterdir()] == ["dora-other.service"]


def test_the_gateway_whose_unit_is_to_be_removed(systemd: Systemd, scope: ScopeIn) -> None:
    unit = scope.root / "dora-gateway.socket"
    state = {"LoadState": "loaded", "ActiveState": "active", "FragmentPath": str(unit)}
    systemd.units[SOCKET_UNIT] = state
    systemd.units[SERVICE_UNIT] = {"LoadState": "loaded", "ActiveState": "active"}
    assert not stop_gateway_of(systemd, scope, [scope.root / "dora.slice"])
    assert systemd.calls == []
    assert stop_gateway_of(systemd, scope, [scope.root / "dora.slice", unit])
    assert systemd.calls == [("StopUnit", SOCKET_UNIT, SERVICE_UNIT)]


def test_a_gateway_that_was_killed_leaves_no_failed_unit(
    systemd: Systemd, scope: ScopeIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    systemd.units[SERVICE_UNIT] = {"LoadState": "loaded", "ActiveState": "failed"}
    done: list[str] = []
    monkeypatch.setattr(systemd, "reset_failed", done.append)
    stop_gateway(systemd, scope)
    assert done == [SERVICE_UNIT]


@pytest.mark.parametrize(
    ("others", "stopped", "told"),
    [
        ([], [BOOT_TARGET, SLICE], []),
        (["foreign.service"], [BOOT_TARGET], ["foreign.service"]),
        (["dora-foreign.service"], [BOOT_TARGET], ["dora-foreign.service"]),
        (["done.service"], [BOOT_TARGET, SLICE], []),
        ([ROBOT], [BOOT_TARGET], []),
    ],
)
def test_the_slice(
    others: list[str], stopped: list[str], told: list[str], systemd: Systemd
) -> None:
    systemd.add(options())
    active = {"LoadState": "loaded", "ActiveState": "active", "ExecStart": []}
    systemd.units |= {
        SLICE: {**active, "RequiredBy": others},
        BOOT_TARGET: dict(active),
        "foreign.service": dict(active),
        "dora-foreign.service": dict(active),
        "done.service": {**active, "ActiveState": "inactive"},
    }
    assert stop_slice(systemd) == told
    assert systemd.calls == [("StopUnit", *stopped)]


def test_processes_that_are_left(
    systemd: Systemd, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mount = fake_cgroups(monkeypatch, tmp_path)
    assert processes_left(systemd, [], count(1.0).__next__) == []
    for unit, pid in ((ROBOT, os.getpid()), ("foreign.service", os.getppid())):
        group = mount / SLICE / unit / "node-a"
        group.mkdir(parents=True)
        (group / "cgroup.procs").write_text(f"{pid}\n")
        (group.parent / "cgroup.events").write_text("populated 1\n")
    (left,) = processes_left(systemd, ["foreign.service"], count(1.0).__next__)
    assert {call[:2] for call in systemd.calls} == {("kill", ROBOT)}
    assert left.startswith(f"process {os.getpid()} (")
