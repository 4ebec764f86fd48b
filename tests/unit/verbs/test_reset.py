"""doractl reset, and what is left of restarts."""

import time

import pytest

from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts import budget as budget_module
from dora_systemd.verbs.facts.budget import restart_budget
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.reset import reset_cells
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

UNIT = "dora-robot.service"


def test_reset_of_what_runs() -> None:
    manager = FakeManager()
    manager.add(options(), NRestarts=3)
    (outcome,) = reset_cells(manager, read_cells(manager))
    assert outcome.text == f"Dataflow reset: {UUID} (robot, restart counter reset, was 3)"
    assert manager.calls == [("reset", UNIT)]
    (again,) = reset_cells(manager, read_cells(manager))
    assert again.text.endswith("(robot, restart counter reset, was 0)")


def test_no_budget_without_policy() -> None:
    manager = FakeManager()
    manager.add(options())
    (cell,) = read_cells(manager)
    assert restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus()) is None


def test_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    facts = {"Restart": "on-failure", "StartLimitBurst": 4, "StartLimitIntervalUSec": 60 * SECOND}
    manager.add(
        options(),
        active="activating",
        SubState="auto-restart",
        NRestarts=1,
        RestartUSec=SECOND,
        StateChangeTimestampMonotonic=0,
        **facts,
    )
    (cell,) = read_cells(manager)
    monkeypatch.setattr(budget_module, "_starts", lambda *_: [])
    assert restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus()) == {
        "used": 0,
        "max": 3,
        "next_us": 0,
        "resets_us": None,
    }


def test_the_runner_waits_for_the_rest_of_a_long_delay() -> None:
    manager = FakeManager()
    facts = {"Restart": "on-failure", "StartLimitBurst": 4, "StartLimitIntervalUSec": 60 * SECOND}
    manager.add(options(), active="activating", SubState="start", NRestarts=0, **facts)
    (cell,) = read_cells(manager)
    begins = time.time_ns() // 1000 + 60 * SECOND
    status = CellStatus(stage="restarting", started_us=begins)
    budget = restart_budget(manager, ScopeIn(True, 1000), cell, status)
    assert budget is not None
    assert 50 * SECOND < (budget["next_us"] or 0) <= 60 * SECOND
    early = restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus(stage="starting"))
    assert early is not None
    assert early["next_us"] is None
