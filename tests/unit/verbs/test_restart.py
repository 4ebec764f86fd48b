"""doractl restart: what could not start again keeps running, and a failure is reported."""

import sys
from pathlib import Path

import pytest

from dora_systemd.decisions.life.refusal import format_refusal, refusal_exit
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.facts.boot import lost_program
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.reason import failure_reason
from dora_systemd.verbs.restart import Ask, require_startable, restart_cells
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

UNIT = "dora-robot.service"
SCOPE = ScopeIn(is_user=True, uid=1000)
BY = "doractl restart"
REFUSAL = DoraSystemdError("cannot use /srv/robot.yml: it is odd", "mend it", ExitCode.BAD_INPUT)


def accept(_: Path) -> DoraSystemdError | None:
    return None


def refuse(_: Path) -> DoraSystemdError | None:
    return REFUSAL


def say_nothing(path: Path) -> DoraSystemdError | None:
    raise DoraSystemdError(f"cannot reach {path}", "", ExitCode.NOT_RUNNING)


@pytest.fixture
def manager() -> FakeManager:
    manager = FakeManager()
    manager.add(options())
    return manager


@pytest.mark.parametrize("ask", [accept, say_nothing])
@pytest.mark.parametrize("active", ["active", "activating", "failed"])
def test_restart(manager: FakeManager, active: str, ask: Ask) -> None:
    manager.units[UNIT]["ActiveState"] = active
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=ask)
    assert outcome.text == f"Dataflow restarted: {UUID} (robot)"
    assert ("RestartUnit", UNIT) in manager.calls


def test_restart_that_fails(manager: FakeManager) -> None:
    manager.units[UNIT] |= {"StatusText": "node camera failed", "ExecMainStatus": 1}
    manager.job_results[UNIT] = "failed"
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.problem == "cannot restart robot: node camera failed (exit code 1)"
    assert outcome.hint == "doractl --user why robot shows more"


def test_the_node_that_failed_has_its_logs_named(manager: FakeManager) -> None:
    reason = "node camera: exit code 1, node plot: exit code 1 because node camera failed"
    manager.units[UNIT] |= {"StatusText": f"failed: {reason}", "ExecMainStatus": 1}
    manager.job_results[UNIT] = "failed"
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.problem == f"cannot restart robot: {reason}"
    more = "doractl --user why robot shows more"
    assert outcome.hint == f"check logs: doractl --user logs robot --node camera; {more}"


def test_a_dataflow_of_another_version_keeps_running(manager: FakeManager) -> None:
    """Its own runner would accept the restart, and the installed one refuses the command line."""
    manager.units[UNIT]["ExecStart"][0][1].insert(-1, "--colour=red")
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.code is ExitCode.BAD_INPUT
    assert outcome.problem.endswith("robot: another version of dora-systemd has started it")
    assert outcome.hint.endswith("doractl list robot says how to start this version")
    assert not any(call[0] == "RestartUnit" and len(call) > 1 for call in manager.calls)
    (forced,) = restart_cells(manager, SCOPE, read_cells(manager), BY, True, ask=accept)
    assert forced.text == f"Dataflow restarted: {UUID} (robot)"


@pytest.mark.parametrize("is_enabled", [False, True])
def test_a_dataflow_whose_python_is_gone_keeps_running(
    manager: FakeManager, is_enabled: bool, tmp_path: Path
) -> None:
    """As after uv tool uninstall and an installation by pipx; its runner knows nothing of it."""
    manager.etc, manager.kind = tmp_path, SCOPE.word
    if is_enabled:
        manager.enable_unit_files([UNIT])
    manager.units[UNIT]["ExecStart"][0][0] = "/nowhere/bin/python"
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.code is ExitCode.BAD_INPUT
    assert outcome.problem.endswith("/nowhere/bin/python, which executes it, does not exist")
    start = "start --enable --name robot /srv/robot.yml" if is_enabled else "start robot"
    assert outcome.hint == f"robot keeps running; instead: doractl stop robot, then doractl {start}"
    assert not any(call[0] == "RestartUnit" and len(call) > 1 for call in manager.calls)
    (forced,) = restart_cells(manager, SCOPE, read_cells(manager), BY, True, ask=accept)
    assert forced.text == f"Dataflow restarted: {UUID} (robot)"


@pytest.mark.parametrize(
    ("is_enabled", "how"),
    [
        (False, "doractl stop robot, then doractl start robot"),
        (True, "doractl start --enable --name robot /srv/robot.yml"),
    ],
)
def test_a_failed_dataflow_whose_python_is_gone(
    manager: FakeManager, is_enabled: bool, how: str, tmp_path: Path
) -> None:
    """A start of its unit would fail as the last one."""
    manager.etc, manager.kind = tmp_path, SCOPE.word
    if is_enabled:
        manager.enable_unit_files([UNIT])
    manager.units[UNIT]["ActiveState"] = "failed"
    (cell,) = read_cells(manager)
    assert lost_program(manager, SCOPE, cell, [(sys.executable, [])], "start") is None
    error = lost_program(manager, SCOPE, cell, [("/nowhere/bin/python", [])], "start")
    assert error is not None
    message = "cannot start robot: /nowhere/bin/python, which executes it, does not exist"
    assert (error.message, error.hint, error.code) == (message, how, ExitCode.BAD_INPUT)


def test_restart_that_the_runner_refuses(manager: FakeManager) -> None:
    """As a start: the hint is no part of the sentence."""
    said = format_refusal(REFUSAL)
    status = int(refusal_exit(REFUSAL))
    manager.units[UNIT] |= {"StatusText": said, "ExecMainStatus": status}
    manager.job_results[UNIT] = "failed"
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.error
    assert (outcome.problem, outcome.hint) == (REFUSAL.message, REFUSAL.hint)
    assert failure_reason(manager, UNIT) == f"{REFUSAL.message}"


def test_restart_without_what_it_needs(manager: FakeManager) -> None:
    manager.add(options("base"), active="failed")
    manager.units[UNIT]["Requires"] = ["dora-base.service"]
    manager.job_results[UNIT] = "dependency"
    robot = [one for one in read_cells(manager) if one.name == "robot"]
    (outcome,) = restart_cells(manager, SCOPE, robot, BY, ask=accept)
    assert outcome.problem == "cannot restart robot: dataflow base, which it needs, failed"
    assert outcome.hint == "doractl --user why base shows more"


def test_what_could_not_start_again_keeps_running(manager: FakeManager) -> None:
    manager.add(options("vision", UUID.replace("5", "6")))

    def ask(path: Path) -> DoraSystemdError | None:
        return REFUSAL if path.parent.name == "robot" else None

    robot, vision = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=ask)
    assert vision.text
    assert (robot.problem, robot.code) == (REFUSAL.message, REFUSAL.code)
    assert robot.hint == (
        "mend it, robot keeps running; doractl restart --force robot restarts it anyway"
    )
    assert [call for call in manager.calls if UNIT in call] == []


def test_a_credential_that_is_not_there_any_more(manager: FakeManager, tmp_path: Path) -> None:
    """Only systemd reads it, so the runner cannot say that the next start would fail."""
    (tmp_path / "key").write_text("x")
    lost = f"{tmp_path}/token"
    manager.units[UNIT]["LoadCredential"] = [["a", f"{tmp_path}/key"], ["store", "x"]]
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.text
    manager.calls.clear()
    manager.units[UNIT]["LoadCredential"].append(["b", lost])
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=accept)
    assert outcome.problem == f"cannot use {lost} as credential b: there is no such file"
    assert outcome.hint.startswith("put it back, robot keeps running; doractl restart --force")
    assert [call for call in manager.calls if UNIT in call] == []


@pytest.mark.parametrize("change", ["forced", "failed"])
def test_what_is_not_asked(manager: FakeManager, change: str) -> None:
    """Nothing is lost by the restart of what does not run."""
    manager.units[UNIT]["ActiveState"] = "failed" if change == "failed" else "active"
    is_forced = change == "forced"
    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, is_forced, ask=refuse)
    assert outcome.text


def test_the_same_as_an_exception(manager: FakeManager) -> None:
    (cell,) = read_cells(manager)
    require_startable(manager, SCOPE, cell, accept)
    with pytest.raises(DoraSystemdError, match="it is odd") as caught:
        require_startable(manager, SCOPE, cell, refuse)
    assert caught.value.code is ExitCode.BAD_INPUT


def test_what_is_frozen_is_thawed_before_it_is_asked(manager: FakeManager) -> None:
    manager.units[UNIT]["FreezerState"] = "frozen"

    def ask(_: Path) -> DoraSystemdError | None:
        assert manager.calls == [("thaw", UNIT)]
        return None

    (outcome,) = restart_cells(manager, SCOPE, read_cells(manager), BY, ask=ask)
    assert outcome.text.endswith("(robot): thawed first, it was frozen")
