"""`doractl why` with real dora, systemd and journald: every end has its reason, in one screen."""

import getpass
import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, is_alive, run, sync_journal, wait_for
from tests.system.terminal import shown

TRACEBACK = """
from dora import Node
node = Node()
for place, event in enumerate(node):
    print("line", place, flush=True)
    if place == 30:
        raise RuntimeError("no camera \\x1b[31m there")
"""
TAKER = "from dora import Node\nfor event in Node():\n    pass\n"
BAD = """
nodes:
  - {id: bad, path: bad.py, inputs: {tick: dora/timer/millis/20}, outputs: [x]}
  - {id: taker, path: taker.py, inputs: {x: bad/x}}
"""
LATE = 'import time\nprint("loading", flush=True)\ntime.sleep(1000)\n'
CRASHES = ("crashed", "exit code 1", "ExitCode(1)", "restarted", "after failure", "Failed with")
KILLED = (
    *("code=killed", "Failed with result", "status=69", "is lost", "failed: ", "was killed ("),
    *("disconnected", "start-limit", "too quickly", "exited", "Failed to start"),
)


def verdict(cell: Cell) -> dict[str, Any]:
    """What why knows, for programs; the screen is checked on the way."""
    sync_journal()
    text = cell.doractl("why", cell.name).stdout
    assert len(text.splitlines()) <= 45, text
    assert text.startswith(f"{cell.name}: ")
    assert "\x1b" not in text
    found: dict[str, Any] = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    assert (found["summary"] or found["now"]) in text
    return found


def failed(cell: Cell) -> None:
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")


def bad(project: Project) -> Path:
    project.write("bad.py", TRACEBACK)
    project.write("taker.py", TAKER)
    return project.write("flow.yml", BAD)


@pytest.mark.warns(*CRASHES)
def test_a_node_that_crashed_for_good(cell: Cell, project: Project) -> None:
    cell.start(bad(project), check=False)
    failed(cell)
    found = verdict(cell)
    assert (found["status"], found["cause"], found["node"]) == ("Failed", "node-failed", "bad")
    assert found["summary"] == "node bad: exit code 1"
    assert found["starved"] == ["taker"]
    assert found["started_us"] < found["at_us"] < found["ended_us"]
    lines = [one["text"] for one in found["last_lines"]]
    assert len(lines) == 20
    assert "line 30" in lines
    assert lines[-1].startswith("RuntimeError: no camera")
    assert f"doractl restart {cell.name}" in found["remedies"][0]
    # Nobody has changed anything by asking.
    assert verdict(cell) == found
    project.write("bad.py", TAKER)
    cell.doractl("restart", cell.name)
    again = verdict(cell)
    assert (again["status"], again["cause"]) == ("Running", None)
    assert again["before"] == {key: found[key] for key in ("summary", "at", "at_us")}


@pytest.mark.warns(*CRASHES, "exit code 3", "ExitCode(3)", "Failed to start", "initializ")
def test_a_failed_start_shows_the_words_of_the_guilty_node(cell: Cell, project: Project) -> None:
    """The others fail because of it, with many more lines; and dora says it again."""
    camera = 'import sys\nprint("no camera there", file=sys.stderr, flush=True)\nsys.exit(3)\n'
    project.write("bad.py", camera)
    project.write("taker.py", TAKER)
    flow = project.write("flow.yml", BAD)
    done = cell.start(flow, check=False)
    assert done.returncode == ExitCode.FAILURE
    *words, message, _ = done.stderr.splitlines()
    assert words == ["  bad: no camera there"]
    assert message.startswith(f"doractl: cannot start {cell.name}: node bad: exit code 3")
    # One that only prepares something ends the others as well, and says nothing.
    project.write("bad.py", "import time\ntime.sleep(0.3)\n")
    done = cell.start(flow, check=False)
    early = "node bad: exit code 0 before it called dora"
    assert done.stderr.splitlines()[-2].startswith(f"doractl: cannot start {cell.name}: {early}, ")
    found = verdict(cell)
    assert (found["node"], found["summary"]) == ("bad", early)
    assert "dataflow-started" not in [one["event"] for one in found["timeline"]]
    assert found["remedies"][0].startswith("have bad call Node() and keep running, or take bad out")


@pytest.mark.warns(*CRASHES)
def test_restarts_come_with_their_causes(cell: Cell, project: Project) -> None:
    words = ("--restart-policy=on-failure", "--max-restarts=2", "--max-restart-delay=500ms")
    cell.start(bad(project), *words, check=False)
    wait_for("it was restarted", lambda: ("node-restarted", "bad") in cell.events())
    sync_journal()
    # It goes on meanwhile, so a second answer may be another one.
    now = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    assert now["restart_history"][0]["reason"] == "exit code 1"
    failed(cell)
    found = verdict(cell)
    assert found["summary"] == "node bad: exit code 1 after 2 restarts"
    assert [(one["owner"], one["node"]) for one in found["restart_history"]] == [
        ("dora", "bad")
    ] * 2
    assert "Restarts: bad 2 (exit code 1)\n" in cell.doractl("why", cell.name).stdout


@pytest.mark.warns(*CRASHES)
def test_a_node_that_stays_away_while_the_others_run(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("doubler.py", TRACEBACK)
    cell.start(flow)
    wait_for("it is degraded", lambda: cell.status.stage == "degraded")
    found = verdict(cell)
    assert (found["status"], found["is_failure"]) == ("Degraded", True)
    assert (found["summary"], found["starved"]) == ("node doubler: exit code 1", ["sink"])
    assert found["now"].startswith("1/3 nodes running")
    assert f"Reason:   doractl why {cell.name}" in cell.doractl("list", cell.name).stdout


@pytest.mark.warns(*KILLED)
def test_a_killed_daemon(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    cell.wait_exchanging()
    os.kill(cell.supervisor_pid("daemon"), signal.SIGKILL)
    failed(cell)
    found = verdict(cell)
    assert found["cause"] == "daemon-lost"
    assert found["summary"] == "the dora daemon is gone (signal SIGKILL)"
    assert {one["node"] for one in found["last_lines"]} >= {"source", "sink"}


@pytest.mark.warns(*KILLED)
def test_systemd_restarts_it_and_gives_it_up(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--restart-policy=on-failure", "--max-restarts=1")
    runner = cell.supervisor_pid("runner")
    os.kill(runner, signal.SIGKILL)
    wait_for("it is back", lambda: cell.show("NRestarts") == "1" and not is_alive(runner))
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    found = verdict(cell)
    assert (found["status"], found["is_failure"]) == ("Running", False)
    ((owner, reason),) = [(one["owner"], one["reason"]) for one in found["restart_history"]]
    assert (owner, reason) == ("systemd", "the supervisor process was killed (SIGKILL)")
    assert found["restart_budget"]["used"] == 1
    os.kill(cell.supervisor_pid("daemon"), signal.SIGKILL)
    failed(cell)
    found = verdict(cell)
    assert (found["cause"], found["given_up"]) == ("daemon-lost", True)
    assert "systemd has stopped restarting it" in found["remedies"][-1]


def is_back(cell: Cell) -> bool:
    """Whether systemd has restarted it once, and it is ready again."""
    return (cell.show("NRestarts"), cell.show("ActiveState")) == ("1", "active")


@pytest.mark.warns(*KILLED, "watchdog", "Watchdog", "Killing process", "SIGABRT", "core-dump")
def test_a_runner_that_hung(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--property", "WatchdogSec=2s")
    os.kill(cell.supervisor_pid("runner"), signal.SIGSTOP)
    # Whatever the policy says: the nodes have done nothing wrong.
    wait_for("it runs again", lambda: is_back(cell), 60)
    text = cell.doractl("why", cell.name).stdout
    assert "the supervisor process hung and was killed by the watchdog" in text


@pytest.mark.warns("not ready within", "Failed with result", "exited", "failed", "Failed to start")
def test_a_start_that_took_too_long(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("late.py", LATE)
    flow.write_text(flow.read_text().rstrip() + "\n  - {id: late, path: late.py}\n")
    done = cell.start(flow, "--start-timeout", f"{bound(3)}s", check=False)
    assert f"doractl {cell.scope.flag} why {cell.name}" in done.stderr
    found = verdict(cell)
    assert (found["cause"], found["node"]) == ("start-timeout", "late")
    assert [one["text"] for one in found["last_lines"]] == ["loading"]


def test_running_and_stopped_by_whom(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    found = verdict(cell)
    assert (found["status"], found["now"]) == ("Running", "3/3 nodes running")
    assert (found["cause"], found["is_failure"], found["restart_history"]) == (None, False, [])
    cell.doractl("stop", cell.name)
    found = verdict(cell)
    assert (found["status"], found["cause"]) == ("Stopped", "stopped")
    caller = f"{getpass.getuser()} (doractl stop)"
    assert found["stopped_by"] == caller
    assert not found["is_failure"]
    # The next one of this name is another dataflow; this one is still there by its UUID.
    cell.start(project.root / "dataflow.yml")
    cell.systemctl("stop")
    assert verdict(cell)["stopped_by"].startswith("a request to systemd")
    old = cell.doractl("why", found["uuid"][:13]).stdout
    assert f"stopped by {caller}" in old


def test_finished_by_itself(cell: Cell, project: Project) -> None:
    project.write("short.py", "from dora import Node\nnode = Node()\n")
    cell.start(project.write("flow.yml", "nodes: [{id: short, path: short.py}]"), check=False)
    wait_for("it has ended", lambda: cell.is_gone)
    found = verdict(cell)
    assert (found["status"], found["cause"]) == ("Finished", "finished")
    assert found["remedies"] == []


def test_unknown_and_in_a_pipe(cell: Cell, project: Project) -> None:
    done = cell.doractl("why", "x" + cell.name, check=False)
    assert done.returncode == ExitCode.NOT_FOUND
    assert done.stderr.startswith("doractl: no dataflow named ")
    unset = cell.doractl("why", "", check=False)
    assert unset.stderr.startswith("doractl: no dataflow named ''"), "and not what failed last"
    cell.start(project.three_nodes())
    command = f"doractl why {cell.name} | head -1"
    assert run("sh", "-c", command).stdout == f"{cell.name}: Running\n"
    # On a terminal, in colours, and no line longer than that.
    text = shown("doractl", "why", cell.name, COLUMNS="60")
    assert text.startswith(f"\x1b[1m{cell.name}\x1b[0m: Running")
    assert max(len(line) for line in text.splitlines()[1:]) <= 60 + len("\x1b[1m\x1b[0m")


@pytest.mark.lab
def test_of_alice(cell: Cell, project: Project) -> None:
    """Her own manager; and the system's journal is none of her business."""
    flow = bad(project)
    user = ("runuser", "-u", "alice", "--", "env", "XDG_RUNTIME_DIR=/run/user/1000", "doractl")

    def why(*words: str) -> "subprocess.CompletedProcess[str]":
        return run(*user, "why", *words, check=False)

    run(*user, "start", str(flow), "--name", "hers", check=False)
    try:
        wait_for("its end", lambda: "hers: Failed" in why("hers").stdout)
        found = json.loads(why("hers", "-o", "json").stdout)
        assert (found["cause"], found["node"], found["starved"]) == (
            "node-failed",
            "bad",
            ["taker"],
        )
        assert found["last_lines"][-1]["text"].startswith("RuntimeError")
        done = why("--system", cell.name)
        assert done.returncode == ExitCode.NO_PERMISSION
        assert "systemd-journal" in done.stderr
    finally:
        run(
            "systemctl", "--user", "--machine=alice@.host", "reset-failed", "dora-hers", check=False
        )


@pytest.mark.warns("cannot run", "Failed", "failed", "exited", "PermissionError")
def test_a_runner_that_cannot_begin_says_why(cell: Cell, project: Project) -> None:
    calls = ("SystemCallFilter=~mkdir mkdirat", "SystemCallErrorNumber=EPERM")
    words = [word for one in calls for word in ("--property", one)]
    done = cell.start(project.three_nodes(), *words, check=False)
    assert cell.show("ActiveState") == "failed", done
    told = json.loads(cell.doractl("why", cell.name, "-o", "json", check=False).stdout)
    assert told["cause"] == "runner-broken"
    assert "cannot run the dataflow: PermissionError: " in told["summary"]
