"""doractl stop and reset, and what is left of restarts."""

import os
import pwd
import signal
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal.note import caller, send_note
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.budget import restart_budget
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.reason import failure_reason
from dora_systemd.verbs.stop import (
    reset_cells,
    stop_cells,
    stop_cells_within,
)
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import fake_journalctl
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options, with_restart

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


def test_nodes_that_had_to_be_killed_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Only a stop that took so long asks the journal."""
    record = b'{"DORA_NODE":"deaf","__REALTIME_TIMESTAMP":"99999999999999999"}\n'
    calls = fake_journalctl(monkeypatch, tmp_path, record)
    manager = FakeManager()
    manager.add(options(grace=0))
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.text.endswith("(robot): killed after 0: deaf")
    assert "DORA_EXIT=signal SIGKILL" in calls.read_text()


def test_stop_that_had_to_kill_says_so() -> None:
    manager = FakeManager()
    manager.add(options())
    manager.after_job[UNIT] = {"ActiveState": "failed", "Result": "timeout"}
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.text.endswith("(robot): it did not start or stop in time and was killed")
    assert outcome.problem == ""


def test_stop_by_force() -> None:
    manager = FakeManager()
    manager.add(options(), active="failed")
    assert stop_cells_within(manager, SCOPE, read_cells(manager), 0)[0].text.endswith("has failed)")
    manager.units[UNIT]["ActiveState"] = "active"
    cells = read_cells(manager)
    manager.units[UNIT]["ActiveState"] = "inactive"  # as soon as it is told to stop
    (outcome,) = stop_cells_within(manager, SCOPE, cells, 0)
    assert outcome.text == f"Dataflow stopped: {UUID} (robot): killed"
    assert manager.calls[:2] == [("StopUnit", UNIT), ("kill", UNIT, signal.SIGKILL, "all")]
    manager.add(options())
    manager.units[UNIT]["ActiveState"] = "inactive"
    assert stop_cells_within(manager, SCOPE, cells, SECOND)[0].text.endswith("(robot)")


@pytest.mark.parametrize("most", [None, 0, SECOND])
def test_what_is_frozen_is_thawed_before_it_is_stopped(most: int | None) -> None:
    manager = FakeManager()
    manager.add(options(), FreezerState="frozen")
    cells = read_cells(manager)
    if most is None:
        (outcome,) = stop_cells(manager, SCOPE, cells)
    else:
        manager.units[UNIT]["ActiveState"] = "inactive"  # as soon as it is told to stop
        (outcome,) = stop_cells_within(manager, SCOPE, cells, most)
    assert [call[0] for call in manager.calls][:2] == ["thaw", "StopUnit"]
    assert "(robot): thawed first, it was frozen" in outcome.text


def test_stop_that_was_cancelled() -> None:
    manager = FakeManager()
    manager.add(options())
    manager.job_results[UNIT] = "canceled"
    (outcome,) = stop_cells(manager, SCOPE, read_cells(manager))
    assert outcome.problem == f"cannot stop {UNIT}: the job was canceled"


@pytest.mark.parametrize("is_restarted", [False, True])
def test_the_links_of_a_head_end_with_it(is_restarted: bool) -> None:
    """A restart that has replaced the stop would start without links, and wait for ever."""
    manager, link = FakeManager(), "doralink-robot:gpu.service"
    manager.add(options(placed=(Placed("yolo", "gpu"),)))
    manager.units[link] = {**manager.units[UNIT], "Description": link}
    manager.after_job[UNIT] = {"ActiveState": "inactive"}
    if is_restarted:
        manager.job_results[UNIT] = "canceled"
        manager.after_job[UNIT] = {"ActiveState": "deactivating", "Job": [7, "/job"]}
    cells = read_cells(manager)
    assert cells[0].has_options, "they are read once, as by the commands"
    stop_cells(manager, SCOPE, cells)
    assert (("StopUnit", link) in manager.calls) is not is_restarted


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"Result": "exit-code", "ExecMainStatus": 78}, "exit code 78"),
        (
            {"Result": "exit-code", "ExecMainStatus": 214},
            "realtime scheduling was refused, see LimitRTPRIO= in systemd.exec(5)"
            " (exit code 214/SETSCHEDULER)",
        ),
        ({"Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 9}, "signal SIGKILL"),
        ({"Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 99}, "signal 99"),
        # as when another terminal kills what this one waits for
        (
            {
                **{"Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 9},
                "StatusText": "stopping, waiting for arm (killed if not ended within 1min)",
            },
            "signal SIGKILL",
        ),
        (
            {"Result": "exit-code", "StatusText": "failed: node a: exit code 3"},
            "node a: exit code 3",
        ),
        (
            {"Result": "timeout", "StatusText": "failed: node a hangs"},
            "node a hangs (it did not start or stop in time and was killed)",
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


def test_names() -> None:
    own = os.getuid()
    assert caller(own, {}) == pwd.getpwuid(own).pw_name
    assert caller(0, {"SUDO_USER": "alice"}) == "root, by sudo of alice"
    assert caller(0, {"SUDO_USER": "root"}) == "root"
    assert caller(2**31, {}) == f"the user {2**31}"


def test_one_datagram_and_nobody_to_take_it(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    send_note(b"MESSAGE=lost\n", path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(path)
        send_note(b"MESSAGE=x\n", path)
        assert journald.recv(100) == b"MESSAGE=x\n"


UNIT = "dora-robot.service"


def test_reset_of_what_runs() -> None:
    manager = FakeManager()
    manager.add(options(), NRestarts=3)
    (outcome,) = reset_cells(manager, SCOPE, read_cells(manager))
    assert outcome.text == f"Dataflow reset: {UUID} (robot, restart counter reset, was 3)"
    assert manager.calls == [("reset", UNIT)]
    (again,) = reset_cells(manager, SCOPE, read_cells(manager))
    assert again.text.endswith("(robot, restart counter reset, was 0)")


def test_no_budget_without_policy() -> None:
    manager = FakeManager()
    manager.add(options())
    (cell,) = read_cells(manager)
    assert restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus()) is None


def test_budget(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    FakeJournal(monkeypatch, tmp_path)
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
    assert restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus()) == {
        "used": 0,
        "max": 3,
        "next_us": 0,
        "resets_us": None,
    }


def test_the_end_of_the_shortest_delay_is_the_runners() -> None:
    manager = FakeManager()
    facts = {"Restart": "on-failure", "StartLimitBurst": 4, "StartLimitIntervalUSec": 60 * SECOND}
    policy = RestartPolicy("on-failure", delay=60 * SECOND)
    now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    manager.add(
        with_restart(options(), policy),
        active="activating",
        SubState="auto-restart",
        NRestarts=0,
        RestartUSec=policy.unit_delay,
        StateChangeTimestampMonotonic=now,
        **facts,
    )
    (cell,) = read_cells(manager)
    budget = restart_budget(manager, ScopeIn(True, 1000), cell, CellStatus())
    assert budget is not None
    assert budget["next_us"] is not None
    assert policy.unit_delay < budget["next_us"] <= policy.delay


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
