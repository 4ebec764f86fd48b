"""Looks of `doractl top`, at a fake systemd and a fake cgroup tree."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.top import Top
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.manager import FakeManager, ScopeIn, options

GROUP = "/dora.slice/dora-robot.service"
SECOND = 1_000_000


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")


Use = Callable[[int], None]


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Use:
    """Sets the CPU time and the waits of a cgroup tree with one node, in seconds."""
    node = fake_cgroups(monkeypatch, tmp_path) / GROUP[1:] / "node-camera"
    node.mkdir(parents=True)

    def use(seconds: int) -> None:
        for place in (node, node.parent):
            (place / "cpu.stat").write_text(f"usage_usec {seconds * SECOND}\n")
            (place / "io.pressure").write_text(f"some avg10=0 total={seconds * SECOND}\n")
            (place / "memory.current").write_text("4096\n")

    return use


def manager_of(*states: str) -> FakeManager:
    manager = FakeManager()
    for number, active in enumerate(states):
        name = "robot" if not number else f"other{number}"
        manager.add(options(name), active=active, ControlGroup="" if number else GROUP)
    return manager


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The monotonic clock in µs, which stands still."""
    now = [SECOND]
    monkeypatch.setattr(time, "clock_gettime_ns", lambda _clock: now[0] * 1000)
    return now


def test_shares_are_those_between_two_looks(scope: Scope, use: Use, clock: list[int]) -> None:
    top = Top(manager_of("active"), scope)
    use(100)
    top.look()
    clock[0] += 4 * SECOND
    use(103)
    (entry,) = top.look().entries
    assert entry.row.cpu_percent == 75.0
    assert entry.row.nodes[0].cpu_percent == 75.0
    assert entry.waits == {"": {"io": 75.0}, "camera": {"io": 75.0}}


def test_another_run_has_nothing_before_it(scope: Scope, use: Use, clock: list[int]) -> None:
    manager = manager_of("active")
    top = Top(manager, scope)
    use(100)
    top.look()
    manager.units["dora-robot.service"]["InactiveExitTimestampMonotonic"] = 2 * SECOND
    clock[0] += 5 * SECOND
    use(1)
    (entry,) = top.look().entries
    assert entry.row.cpu_percent == 25.0
    assert entry.waits == {}


def test_only_what_runs_and_is_chosen(scope: Scope, use: Use) -> None:
    use(1)
    manager = manager_of("active", "failed", "activating")
    everything = Top(manager, scope).look()
    assert [entry.row.name for entry in everything.entries] == ["other2", "robot"]
    chosen = Top(manager, scope, ["robot"])
    assert [entry.row.name for entry in chosen.look().entries] == ["robot"]
    del manager.units["dora-robot.service"]
    assert chosen.look().entries == []


@pytest.mark.parametrize(
    ("selector", "code"), [("robo", ExitCode.NOT_FOUND), ("other1", ExitCode.NOT_RUNNING)]
)
def test_selectors_that_are_of_no_use(selector: str, code: ExitCode, scope: Scope) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        Top(manager_of("active", "failed"), scope, [selector])
    assert caught.value.code is code
