"""start NAME and restart NAME of what has ended: with the UUID and the settings it had."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, journalctl, run, sync_journal, wait_for
from tests.system.faults.table import LOST

SAYS = """
import os
from dora import Node
node = Node()
print("COLOR", os.environ.get("COLOR"), "LIMIT", os.environ.get("LIMIT"), flush=True)
for event in node:
    pass
"""
FLOW = "nodes: [{id: says, path: says.py, inputs: {tick: dora/timer/millis/500}}]\n"


@pytest.fixture
def flow(project: Project) -> Path:
    project.write("says.py", SAYS)
    project.write("more.env", "LIMIT=3\n")
    return project.write("dataflow.yml", FLOW)


def known(cell: Cell) -> dict[str, Any]:
    rows: list[dict[str, Any]] = json.loads(cell.doractl("list", "--all", "-o", "json").stdout)
    (row,) = [row for row in rows if row["name"] == cell.name]
    return row


def said(cell: Cell, text: str, times: int) -> None:
    wait_for(text, lambda: cell.messages("says").count(text) == times)


def end(cell: Cell) -> None:
    """Stop, as far as systemd has forgotten the unit."""
    cell.doractl("stop", cell.name)
    wait_for("systemd has forgotten it", lambda: cell.show("LoadState") == "not-found")
    sync_journal()


def test_with_the_settings_it_had(cell: Cell, flow: Path) -> None:
    place = flow.parent
    # Relative paths are those of the directory in which the start was typed.
    options = ["--env", "COLOR=red", "--env-file", "more.env", "--nice", "5"]
    command = ["doractl", cell.scope.flag, "start", flow.name, "--name", cell.name, *options]
    assert run(*command, cwd=place).returncode == 0
    uuid = known(cell)["uuid"]
    said(cell, "COLOR red LIMIT 3", 1)
    end(cell)
    done = cell.doractl("start", cell.name)
    assert done.stdout.startswith(f"Dataflow started: {uuid}\n")
    said(cell, "COLOR red LIMIT 3", 2)
    assert cell.show("Nice") == "5"
    # What runs goes on running.
    pid = cell.show("MainPID")
    done = cell.doractl("start", cell.name)
    assert done.stdout == f"Dataflow already running: {uuid} ({cell.name})\n"
    assert cell.show("MainPID") == pid
    end(cell)
    done = cell.doractl("restart", uuid[:8])
    assert done.stdout == f"Dataflow restarted: {uuid} ({cell.name})\n"
    said(cell, "COLOR red LIMIT 3", 3)
    assert cell.show("Nice") == "5"
    end(cell)
    # Options change what it had, from now on.
    cell.doractl("start", f"dora-{cell.name}", "--env", "COLOR=blue")
    said(cell, "COLOR blue LIMIT 3", 1)
    end(cell)
    cell.doractl("start", cell.name)
    said(cell, "COLOR blue LIMIT 3", 2)
    assert known(cell)["uuid"] == uuid


@pytest.mark.warns(
    "says: exit code 5", "Failed with result", "exited", "crashed", "is being restarted"
)
def test_after_a_failure_and_reset(cell: Cell, project: Project, flow: Path) -> None:
    broken = SAYS.replace("for event in node:\n    pass", "raise SystemExit(5)")
    cell.start(flow)
    project.write("says.py", broken)
    cell.doractl("node", "restart", cell.name, "says", check=False)
    wait_for("its end", lambda: cell.show("ActiveState") == "failed")
    cell.doractl("reset", cell.name)
    wait_for("systemd has forgotten it", lambda: cell.show("LoadState") == "not-found")
    project.write("says.py", SAYS)
    done = cell.doractl("restart", cell.name)
    assert done.stdout.startswith("Dataflow restarted: ")
    assert known(cell)["status"] == "Running"


def test_an_enabled_one(cell: Cell, flow: Path) -> None:
    cell.start(flow, "--enable")
    try:
        cell.doractl("stop", cell.name)
        assert cell.doractl("start", cell.name).stdout.startswith("Dataflow started: ")
        assert cell.show("FragmentPath").startswith("/etc/")
        cell.doractl("stop", cell.name)
        done = cell.doractl("start", cell.name, "--env", "A=1", check=False)
        assert done.returncode == ExitCode.NAME_IN_USE
        assert "it is enabled with other settings" in done.stderr
    finally:
        cell.doractl("disable", cell.name)


def test_names_that_are_none(cell: Cell, tmp_path: Path) -> None:
    (tmp_path / cell.name).mkdir()

    def start(*words: str) -> "subprocess.CompletedProcess[str]":
        return run("doractl", cell.scope.flag, "start", *words, cwd=tmp_path, check=False)

    for verb in ("start", "restart"):
        done = run("doractl", cell.scope.flag, verb, cell.name, cwd=tmp_path, check=False)
        assert done.returncode == ExitCode.NOT_FOUND
        assert done.stderr.startswith(f"doractl: no dataflow named '{cell.name}'\nhint: ")
    assert start("nothing.yml").returncode == ExitCode.BAD_INPUT


@pytest.mark.lab
def test_another_users_words_start_nothing(cell: Cell, project: Project) -> None:
    """Only records of root are believed, whatever a user writes into the journal."""
    lines = (
        f"MESSAGE=Start of dataflow {cell.name} requested by root",
        "DORA_EVENT=start-asked",
        "DORA_SCOPE=system",
        f"DORA_DATAFLOW_NAME={cell.name}",
        "DORA_DATAFLOW=550e8400-e29b-41d4-a716-446655440000",
        f"DORA_FILE={project.three_nodes()}",
        "DORA_SETTINGS={}",
        "_UID=0",
    )
    send = "import sys; from dora_systemd.adapters.journal.note import send_note as send; "
    send += "send('\\n'.join([*sys.argv[1:], '']).encode())"
    run("runuser", "-u", "alice", "--", sys.executable, "-c", send, *lines)
    mine = ("-o", "cat", f"DORA_DATAFLOW_NAME={cell.name}")
    wait_for("the record", lambda: journalctl(*mine))
    done = cell.doractl("start", cell.name, check=False)
    assert done.returncode == ExitCode.NOT_FOUND, done.stdout


@pytest.mark.warns(*LOST)
def test_a_start_that_is_refused_leaves_what_has_failed(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--restart-policy", "no")
    cell.systemctl("kill", "--signal=KILL")
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    done = cell.start(project.root / "missing.yml", check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert cell.show("ActiveState") == "failed"
    assert known(cell)["status"] == "Failed"
