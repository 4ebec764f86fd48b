"""`-o json` of verbs with a fake systemd behind them: outcomes, errors, warnings."""

import json
from pathlib import Path
from typing import Any

import click
import pytest

from dora_systemd.cli import main
from dora_systemd.cli.edge import asks_for_json
from dora_systemd.cli.group import VERBS
from dora_systemd.cli.parameters import print_warnings
from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, options

OTHER = UUID[:-1] + "1"
UNIT = "dora-robot.service"
NOT_FOR_PROGRAMS = {"bundle", "run", "dora", "env", "export", "logs", "member"}
"""They print what a node, dora or a shell prints or reads; logs has the journal's JSON."""


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeManager:
    """The dataflow robot runs, the dataflow other has failed; a boot starts robot."""
    manager = FakeManager()
    manager.etc = tmp_path
    manager.add(options())
    manager.add(options("other", OTHER), active="failed", StatusText="failed: node a: exit code 1")
    wants = tmp_path / "systemd/system/dora.target.wants"
    wants.mkdir(parents=True)
    (wants / UNIT).symlink_to(f"../{UNIT}")
    fake_systemd(monkeypatch, manager)
    monkeypatch.setattr(Scope, "runtime_root", tmp_path / "run")
    FakeJournal(monkeypatch, tmp_path)
    return manager


Printed = pytest.CaptureFixture[str]


def objects(capsys: Printed, *words: str, status: int = 0) -> list[dict[str, Any]]:
    """What a verb prints with JSON, one object in a line."""
    assert main.run(["--system", *words, "-o", "json"]) == status
    out, err = capsys.readouterr()
    assert err == ""
    return [json.loads(line) for line in out.splitlines()]


def error(capsys: Printed, *words: str) -> dict[str, Any]:
    assert main.run([*words]) != 0
    out, err = capsys.readouterr()
    found = json.loads(err)
    assert (out, found["schema"], list(found)) == ("", 1, ["schema", "error"])
    return dict(found["error"])


def parameters(command: click.Command) -> set[str]:
    members = getattr(command, "commands", {}).values()
    shared = [parameters(one) for one in members] or [{one.name or "" for one in command.params}]
    return set.intersection(*shared)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_prints_json(verb: str) -> None:
    assert ("output" in parameters(VERBS[verb].command)) == (
        verb not in NOT_FOR_PROGRAMS - {"logs"}
    )


@pytest.mark.usefixtures("manager")
def test_outcomes(capsys: Printed) -> None:
    robot, other = objects(capsys, "stop", "robot", "other")
    assert robot == {
        "schema": 1,
        "action": "stop",
        "name": "robot",
        "uuid": UUID,
        "unit": UNIT,
        "node": None,
        "result": "done",
        "text": f"Dataflow stopped: {UUID} (robot)",
        "details": {},
        "error": None,
    }
    assert other.keys() == robot.keys()
    assert (other["name"], other["result"]) == ("other", "unchanged")


def test_a_start_of_what_is_stopping(manager: FakeManager, capsys: Printed) -> None:
    """It does not run on, so this is no success."""
    manager.add(options("ending", UUID[:-1] + "2"), active="deactivating")
    found = error(capsys, "--system", "start", "ending", "-o", "json")
    assert found["message"] == "cannot start ending: it is stopping"
    assert found["exit_status"] == ExitCode.NAME_IN_USE


def test_an_outcome_with_a_problem(manager: FakeManager, capsys: Printed) -> None:
    manager.job_results[UNIT] = "canceled"
    (outcome,) = objects(capsys, "restart", "robot", status=ExitCode.FAILURE)
    assert (outcome["action"], outcome["result"], outcome["text"]) == ("restart", "failed", None)
    assert outcome["error"] == {
        "message": "cannot restart robot: it was stopped while it started",
        "hint": "doractl --system why robot shows more",
        "exit_status": 1,
        "lines": [],
    }


def test_nothing_to_do_is_no_object(manager: FakeManager, capsys: Printed) -> None:
    manager.units.clear()
    assert objects(capsys, "stop", "--all") == []
    assert objects(capsys, "reset", "--all") == []


@pytest.mark.usefixtures("manager")
def test_the_same_dataflow_in_list_and_top(
    capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda _seconds: None)
    assert main.run(["--system", "list", "robot", "-o", "json"]) == 0
    one = json.loads(capsys.readouterr().out)
    assert main.run(["list", "--system", "-o", "json"]) == 0
    _, listed = json.loads(capsys.readouterr().out)  # below the failed one
    (look,) = objects(capsys, "top", "--once")
    assert listed == one == {"schema": 1, **look["dataflows"][0]}
    assert listed["enabled"] is True
    assert listed["file"] == "/srv/robot.yml"
    assert (listed["nodes_total"], listed["started"], listed["text"]) == (None, None, None)


def test_the_budget_is_the_same_in_list_and_top(
    manager: FakeManager, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda _seconds: None)
    manager.units[UNIT] |= {"Restart": "on-failure", "StartLimitBurst": 6}
    expected = {"used": 0, "max": 5, "next_us": None, "resets_us": None}
    main.run(["list", "--system", "-o", "json"])
    _, listed = json.loads(capsys.readouterr().out)
    (look,) = objects(capsys, "top", "--once")
    assert listed["restart_budget"] == look["dataflows"][0]["restart_budget"] == expected


@pytest.mark.usefixtures("manager")
def test_errors(capsys: Printed) -> None:
    for words in (["list", "robbot", "-o", "json"], ["stop", "robbot", "--output=json"]):
        assert error(capsys, "--system", *words) == {
            "message": "no dataflow named 'robbot'",
            "hint": "did you mean robot?",
            "exit_status": ExitCode.NOT_FOUND,
            "lines": [],
        }
    wrong = error(capsys, "stop", "-o", "json")
    assert (wrong["message"], wrong["exit_status"]) == ("cannot stop: give names or --all", 2)
    assert error(capsys, "list", "--oll", "-ojson")["message"] == "unknown option --oll"
    assert error(capsys, "strat", "-o", "json")["hint"] == "did you mean doractl start?"
    wrong = error(capsys, "list", "-q", "-o", "json")
    assert (wrong["message"], wrong["hint"]) == ("cannot use --quiet with JSON", "omit one of them")


def test_who_asks_for_json() -> None:
    for words in (["-o", "json"], ["-ojson"], ["--output", "json"], ["--output=json"]):
        assert asks_for_json(["stop", *words, "--", "x"])
    for other in (["json"], ["-o", "table"], ["x", "--", "-o", "json"], ["--output=jsonl"]):
        assert not asks_for_json(["dora", *other])


def test_warnings(capsys: Printed) -> None:
    print_warnings(["no linger", ""])
    assert capsys.readouterr().err == "doractl: no linger\n"
    context = click.Context(click.Command("enable"))
    context.meta["dora_systemd.output"] = "json"
    with context:
        print_warnings(["no linger"])
    assert json.loads(capsys.readouterr().err) == {"schema": 1, "warning": {"message": "no linger"}}
