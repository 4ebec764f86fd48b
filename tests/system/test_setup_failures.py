"""Dataflows whose runner systemd could not execute: nothing of ours has recorded anything."""

import json
import os
import signal
from pathlib import Path

import pytest

from dora_systemd.decisions.life.refusal import setup_failure
from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, sync_journal, wait_for
from tests.system.test_list_questions import check_truth, is_running

SANDBOX = "its sandbox could not be set up (exit code 226/NAMESPACE)"


def binds(project: Project) -> tuple[Path, tuple[str, str]]:
    """A directory without which the sandbox cannot be set up, and the words for doractl."""
    place = project.root / "bound"
    return place, ("--property", f"BindPaths={place}:/mnt")


def told(cell: Cell) -> set[str]:
    """The cause of the end by list --all, list NAME and why NAME."""
    sync_journal()
    rows = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    one = json.loads(cell.doractl("list", cell.name, "-o", "json", check=False).stdout)
    why = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    (text,) = [row["text"] for row in rows if row["name"] == cell.name]
    return {text, one["text"], why["summary"]}


def wait_failed(cell: Cell) -> None:
    """Return when systemd has given it up."""
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")


@pytest.mark.warns(
    *("Failed", "status=226", "No such file", "lost", "exited", "too quickly", "code=killed")
)
def test_one_cause_in_the_same_words(cell: Cell, project: Project) -> None:
    place, words = binds(project)
    place.mkdir()
    cell.start(project.three_nodes(), *words, "--restart-policy", "always", "--max-restarts", "1")
    place.rmdir()
    os.kill(cell.supervisor_pid("runner"), signal.SIGKILL)
    wait_failed(cell)
    assert told(cell) == {SANDBOX}
    assert SANDBOX in cell.doractl("restart", cell.name, check=False).stderr
    wait_failed(cell)
    # Nothing but the journal knows it then.
    cell.doractl("reset", cell.name)
    wait_for("it is unloaded", lambda: cell.show("LoadState") == "not-found")
    assert told(cell) == {SANDBOX}


@pytest.mark.warns("Failed", "status=226", "No such file", "exited")
def test_a_restart_that_never_began(cell: Cell, project: Project) -> None:
    """The last that we have recorded is a stop."""
    place, words = binds(project)
    place.mkdir()
    cell.start(project.three_nodes(), *words)
    place.rmdir()
    assert SANDBOX in cell.doractl("restart", cell.name, check=False).stderr
    wait_failed(cell)
    assert told(cell) == {SANDBOX}
    cell.doractl("reset", cell.name)
    wait_for("it is unloaded", lambda: cell.show("LoadState") == "not-found")
    assert told(cell) == {SANDBOX}
    rows = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    assert [one["status"] for one in rows if one["name"] == cell.name] == ["Failed"]


@pytest.mark.warns("Failed", "status=226", "No such file", "exited")
def test_a_failure_of_another_dataflow_of_that_name(cell: Cell, project: Project) -> None:
    """It has recorded nothing, and the one before it was stopped."""
    place, words = binds(project)
    cell.start(project.three_nodes())
    cell.doractl("stop", cell.name)
    assert SANDBOX in cell.start(project.three_nodes(), *words, check=False).stderr
    assert not place.exists()
    wait_failed(cell)
    cell.doractl("reset", cell.name)
    wait_for("it is unloaded", lambda: cell.show("LoadState") == "not-found")
    sync_journal()
    rows = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    assert [one["status"] for one in rows if one["name"] == cell.name] == ["Stopped"]


@pytest.mark.warns("Failed", "status=226", "No such file", "exited")
@pytest.mark.parametrize("verb", ["run", "start"])
def test_a_terminal_that_waits_for_lines(cell: Cell, project: Project, verb: str) -> None:
    """The runner, which has never begun, cannot say it."""
    _, words = binds(project)
    attached = ("--attach",) if verb == "start" else ()
    flow = str(project.three_nodes())
    done = cell.doractl(verb, flow, "--name", cell.name, *words, *attached, check=False)
    assert done.returncode == ExitCode.FAILURE
    assert f"doractl: cannot start {cell.name}: {SANDBOX}\n" in done.stderr
    assert done.stdout == ""


@pytest.mark.warns("Failed", "status=226", "No such file", "exited")
def test_lives_that_never_began_are_restarts(cell: Cell, project: Project) -> None:
    place, words = binds(project)
    policy = ("--restart-policy", "always", "--max-restarts", "1000")
    done = cell.start(project.three_nodes(), *words, *policy, check=False)
    assert SANDBOX in done.stderr
    wait_for("two restarts", lambda: int(cell.show("NRestarts")) > 1)
    place.mkdir()
    wait_for("it runs", lambda: is_running(cell))
    check_truth(cell)
    sync_journal()
    row = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    assert row["restarts"] == row["restart_budget"]["used"] == int(cell.show("NRestarts"))


def test_the_names_are_systemds() -> None:
    rows = run("systemd-analyze", "exit-status").stdout.splitlines()
    ours = [row.split() for row in rows if row.endswith(" systemd") and " 255 " not in row]
    assert len(ours) > 40
    for name, status, _ in ours:
        assert setup_failure(int(status)).endswith(f"(exit code {status}/{name})")
