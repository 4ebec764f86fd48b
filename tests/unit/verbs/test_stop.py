"""stop, restart and the reasons that systemd remembers."""

from typing import Any

import pytest

from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.reason import failure_reason
from dora_systemd.verbs.stop import restart_cells, stop_cells
from tests.unit.fakes.manager import UUID, FakeManager, options

UNIT = "dora-robot.service"

SCOPE = Scope(is_user=False, uid=0)


def test_stop() -> None:
    manager = FakeManager()
    manager.add(options())
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.text == f"Dataflow stopped: {UUID} (robot)"
    assert manager.calls == [("StopUnit", UNIT)]


def test_several_stop_in_one_call() -> None:
    manager = FakeManager()
    for name in ("a", "b", "c"):
        manager.add(options(name))
    manager.units["dora-b.service"]["ActiveState"] = "failed"
    outcomes = stop_cells(manager, SCOPE, read_cells(manager))
    assert manager.calls == [("StopUnit", "dora-a.service", "dora-c.service")]
    assert [one.problem for one in outcomes] == ["", "", ""]
    assert outcomes[1].text == f"Dataflow not running: {UUID} (b has failed)"


def test_stop_that_had_to_kill_says_so() -> None:
    manager = FakeManager()
    manager.add(options())
    manager.after_job[UNIT] = {"ActiveState": "failed", "Result": "timeout"}
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.text.endswith("(robot): it did not end in time and was killed")
    assert outcome.problem == ""


def test_stop_that_was_cancelled() -> None:
    manager = FakeManager()
    manager.add(options())
    manager.job_results[UNIT] = "canceled"
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.problem == f"cannot stop {UNIT}: the job was canceled"


def test_restart() -> None:
    manager = FakeManager()
    manager.add(options(), active="failed")
    (outcome,) = restart_cells(manager, read_cells(manager))
    assert outcome.text == f"Dataflow restarted: {UUID} (robot)"


def test_restart_that_fails() -> None:
    manager = FakeManager()
    manager.add(options(), StatusText="node camera failed", ExecMainStatus=1)
    manager.job_results[UNIT] = "failed"
    (outcome,) = restart_cells(manager, read_cells(manager))
    assert outcome.problem == f"cannot restart {UNIT}: node camera failed (exit code 1)"


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"Result": "exit-code", "ExecMainStatus": 78}, "exit code 78"),
        (
            {"Result": "exit-code", "ExecMainStatus": 214},
            "realtime scheduling was refused, see LimitRTPRIO= in systemd.exec(5) (exit code 214)",
        ),
        ({"Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 9}, "signal SIGKILL"),
        ({"Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 99}, "signal 99"),
        (
            {"Result": "exit-code", "StatusText": "failed: node a: exit code 3"},
            "node a: exit code 3",
        ),
        (
            {"Result": "timeout", "StatusText": "failed: node a hangs"},
            "node a hangs (it did not end in time and was killed)",
        ),
        ({"Result": "watchdog"}, "the supervisor process hung and was killed by the watchdog"),
        ({"Result": "brand-new", "ExecMainCode": 0}, "brand-new"),
        (
            {"Result": "oom-kill", "StatusText": "detector used 2G"},
            "detector used 2G (it ran out of memory)",
        ),
    ],
)
def test_reasons(facts: dict[str, Any], reason: str) -> None:
    manager = FakeManager()
    manager.add(options(), **facts)
    assert failure_reason(manager, UNIT) == reason
