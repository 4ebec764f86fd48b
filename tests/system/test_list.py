"""doractl list: what runs, what it uses, what ran before."""

import json
import os
import re
import signal
import subprocess
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.verbs.facts.selector import OF_SYSTEM
from tests.system.cells import Cell, Project, is_alive, run, wait_for
from tests.system.terminal import shown


def listed(cell: Cell, *words: str) -> dict[str, dict[str, Any]]:
    """Rows of `list -o json` by name."""
    rows = json.loads(cell.doractl("list", "-o", "json", *words).stdout)
    return {row["name"]: row for row in rows}


def test_no_dataflow() -> None:
    done = run("doractl", "list")
    assert (done.stdout, done.stderr) == ("No dataflow is running.\n", "")
    assert json.loads(run("doractl", "list", "-o", "json").stdout) == []


@pytest.mark.warns("killed", "failed", "Failed", "ended")
def test_what_failed_comes_first_with_its_reason(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    os.kill(int(cell.show("MainPID")), signal.SIGKILL)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    (row,) = listed(cell).values()
    assert (row["name"], row["status"]) == (cell.name, "Failed")
    assert "killed" in row["text"]
    assert row["text"] in cell.doractl("list").stdout
    assert cell.doractl("list", "-q").stdout == ""
    assert cell.doractl("why").stdout.startswith(f"{cell.name}: Failed\n")
    hint = f"hint: known dataflows: {cell.name}\n"
    assert cell.doractl("restart", check=False).stderr.endswith(hint)


def test_it_needs_nothing_of_ours_alive(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    pids = list(cell.all_pids())
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        assert listed(cell)[cell.name]["nodes_alive"] == 3
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


@pytest.mark.warns(
    *("code=killed", "Failed with result", "status=69", "process was killed ("),
    "server disconnected unexpectedly",
)
def test_restarts_are_counted_and_the_uuid_stays(cell: Cell, project: Project) -> None:
    words = ("--property", "Restart=on-failure", "--property", "RestartSec=100ms", "-o", "json")
    started = json.loads(cell.start(project.three_nodes(), *words).stdout)
    runner = cell.supervisor_pid("runner")
    os.kill(runner, signal.SIGKILL)
    wait_for("it is back", lambda: cell.show("NRestarts") == "1" and not is_alive(runner))
    wait_for("it runs", lambda: listed(cell).get(cell.name, {}).get("status") == "Running")
    row = listed(cell)[cell.name]
    assert (row["uuid"], row["restarts"]) == (started["uuid"], 1)


def test_ended_dataflows(cell: Cell, project: Project) -> None:
    started = json.loads(cell.start(project.three_nodes(), "-o", "json").stdout)
    cell.doractl("stop", cell.name)
    assert cell.name not in listed(cell)
    row = listed(cell, "--all")[cell.name]
    assert (row["status"], row["uuid"]) == ("Stopped", started["uuid"])
    assert row["ended_us"] > 0
    for selector in (cell.name, started["uuid"][:8]):
        done = cell.doractl("list", selector, check=False)
        assert done.returncode == ExitCode.NOT_RUNNING
        assert "Status:   Stopped" in done.stdout


CRASH = "from dora import Node\nNode()\nraise SystemExit(3)\n"
CRASHING = "nodes: [{id: bad, path: bad.py, inputs: {t: dora/timer/millis/20}}]"
CRASHES = ("crashed", "exit code 3", "ExitCode(3)", "Failed with", "failed: ", "restarted", "after")


def crash(cell: Cell, project: Project, *words: str) -> None:
    """Start a dataflow whose node fails, and wait for its end in the journal."""
    project.write("bad.py", CRASH)
    cell.start(project.write("bad.yml", CRASHING), *words, check=False)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    wait_for("it is recorded", lambda: ("dataflow-failed", "") in cell.events())


@pytest.mark.warns(*CRASHES)
def test_what_has_ended_and_why(cell: Cell, project: Project) -> None:
    """One row for a name, whatever ran before under it."""
    other = Cell(f"{cell.name}-two")
    flow = project.three_nodes()
    for _ in range(2):
        other.start(flow)
        other.doractl("stop", other.name)
    crash(cell, project)
    rows = cell.doractl("list", "--all").stdout.splitlines()
    assert rows[0].split()[-3:] == ["BOOT", "ENDED", "WHY"]
    assert len([row for row in rows if row.split()[1] == other.name]) == 1
    newest, *older = rows[1:]
    assert newest.split()[1:3] == [cell.name, "Failed"]
    assert re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  node bad: exit code 3$", newest)
    assert older[0].split()[1:3] == [other.name, "Stopped"]
    last = cell.doractl("list", "--last", "1").stdout.splitlines()
    assert last[1:] == [line for line in last if cell.name in line.split()]
    screen = shown(
        "doractl", cell.scope.flag, "list", "-a", COLUMNS="60", NO_COLOR="1"
    ).splitlines()
    assert max(map(len, screen)) <= 60
    assert screen[-1] == "Why: doractl why NAME; all runs: doractl logs NAME --run ALL"
    one = cell.doractl("list", cell.name, check=False).stdout
    assert "Status:   Failed (node bad: exit code 3)\n" in one
    assert "\nEnded:    2" in one


@pytest.mark.warns(*CRASHES)
def test_options_of_doras_own_list(cell: Cell, project: Project) -> None:
    def uuids(*words: str) -> list[str]:
        return cell.doractl("list", "-q", *words).stdout.splitlines()

    uuid = json.loads(cell.start(project.three_nodes(), "-o", "json").stdout)["uuid"]
    other = Cell(f"{cell.name}-two")
    crash(other, project)
    try:
        assert uuids() == uuids("--status", "running") == uuids(cell.name) == [uuid]
        failed = listed(cell, "--status", "failed")
        assert failed[other.name]["status"] == "Failed"
        assert cell.name not in failed
        assert uuids("--status", "failed", "--last", "1") == [failed[other.name]["uuid"]]
        assert uuids("--name", f"{cell.name[1:-1].upper()}*TWO", "-a")[0] != uuid
        for column in ("cpu", "memory", "uptime", "name"):
            assert uuids("--all", "--name", cell.name, "--sort-by", column)[0] == uuid
        assert uuids("--name", "no-such-name") == []
    finally:
        other.end()


@pytest.mark.warns(*CRASHES)
def test_colors_by_state(cell: Cell, project: Project) -> None:
    crash(cell, project)
    command = ("doractl", cell.scope.flag, "list", "-a")
    screen = shown(*command, COLUMNS="300")
    assert screen.startswith("\x1b[4mUUID ")
    assert re.search(rf"{cell.name} +\x1b\[31mFailed\x1b\[0m ", screen)
    assert "\x1b" not in shown(*command, NO_COLOR="1")
    assert "\x1b" not in run(*command).stdout
    assert "\x1b[31mFailed" in run(*command, env={**os.environ, "SYSTEMD_COLORS": "1"}).stdout


@pytest.mark.warns(*CRASHES)
def test_restarts_have_one_meaning(cell: Cell, project: Project) -> None:
    """Those of a node are dora's, and not among those of the dataflow."""
    words = (
        "--restart-policy",
        "on-failure",
        "--max-restarts",
        "1",
        "--max-restart-delay",
        "500ms",
    )
    crash(cell, project, *words)
    assert listed(cell, "--all")[cell.name]["restarts"] == int(cell.show("NRestarts")) == 0
    whose = "0 of the dataflow by systemd"
    assert f"\nRestarts: {whose}\n" in cell.doractl("list", cell.name, check=False).stdout
    assert "Restarts: bad 1 (exit code 3)\n" in cell.doractl("why", cell.name).stdout


@pytest.mark.lab
def test_a_user_has_dataflows_of_his_own(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())

    def as_alice(*words: str) -> "subprocess.CompletedProcess[str]":
        return run("su", "alice", "-s", "/bin/sh", "-c", f"exec doractl {' '.join(words)}")

    flow = project.root / "dataflow.yml"
    as_alice("start", str(flow), "--name", "hers")
    try:
        (row,) = json.loads(as_alice("list", "-o", "json").stdout)
        assert (row["name"], row["nodes_alive"], row["status"]) == ("hers", 3, "Running")
        assert "hers" not in listed(cell)
        done = run("su", "bob", "-s", "/bin/sh", "-c", "exec doractl list")
        other = r"In system scope: \d+ \(doractl list --system\)"
        assert re.fullmatch(rf"No dataflow is running\.\n{other}\n", done.stdout), done.stdout
        for verb in ("list", "why", "stop"):
            words = f"exec doractl {verb} {cell.name}"
            missing = run("su", "bob", "-s", "/bin/sh", "-c", words, check=False)
            assert f"hint: {OF_SYSTEM}" in missing.stderr.splitlines(), missing.stderr
    finally:
        as_alice("stop", "--all")


class TestWhatRuns:
    """All of them look at the same dataflow."""

    def test_table(self, running: Cell) -> None:
        header, row = running.doractl("list").stdout.splitlines()
        assert header.split() == [
            "UUID",
            "NAME",
            "STATUS",
            "UPTIME",
            "NODES",
            "CPU%",
            "MEM",
            "RESTARTS",
            "BOOT",
        ]
        fields = row.split()
        assert fields[0] in running.show("ExecStart")
        assert len(fields[0]) == 8
        assert fields[1:3] == [running.name, "Running"]
        assert re.fullmatch(r"00:00:\d\d", fields[3])
        assert fields[4] == "3/3"
        assert float(fields[5]) > 0
        assert fields[6].endswith("M")
        assert fields[7:] == ["0", "-"]

    def test_one_dataflow(self, running: Cell, class_project: Project) -> None:
        shown = running.doractl("list", running.name).stdout
        flow = class_project.root / "dataflow.yml"
        for part in (f"Unit:     {running.unit}", f"File:     {flow}", "Status:   Running (3/3 no"):
            assert part in shown
        row = json.loads(running.doractl("status", running.name, "-o", "json").stdout)
        nodes = {node["node"]: node for node in row["nodes"]}
        assert list(nodes) == ["source", "doubler", "sink"]
        for name, node in nodes.items():
            assert running.pids(f"node-{name}") == [node["pid"]]
            assert node["memory_bytes"] > 1 << 20
            assert node["state"] == "running"

    def test_selectors(self, running: Cell) -> None:
        uuid = running.status.uuid
        for selector in (running.name, running.unit, uuid, uuid[:8], uuid.upper()):
            assert f"Dataflow: {uuid}" in running.doractl("list", selector).stdout

    def test_a_pattern(self, running: Cell) -> None:
        (row,) = json.loads(running.doractl("list", f"{running.name[:-1]}*", "-o", "json").stdout)
        assert row["uuid"]
        done = running.doractl("list", f"{running.name}x*", check=False)
        assert done.returncode == ExitCode.NOT_FOUND

    @pytest.mark.lab
    def test_without_the_node_table(self, running: Cell) -> None:
        """What another user sees: the directory of the cell is closed."""
        command = ("su", "bob", "-s", "/bin/sh", "-c", "exec doractl --system list -o json")
        (row,) = json.loads(run(*command).stdout)
        assert (row["name"], row["nodes_alive"], row["nodes_total"]) == (running.name, 3, 3)
        assert row["memory_bytes"] > 1 << 20

    def test_unknown_selector(self, running: Cell) -> None:
        done = running.doractl("list", running.name[:-1], check=False)
        assert done.returncode == ExitCode.NOT_FOUND
        assert f"did you mean {running.name}" in done.stderr
