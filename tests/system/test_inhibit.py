"""doractl inhibit, and the lock file of nodes: the kernel says who inhibits a restart."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, is_alive, journalctl, run, wait_for

ARM = """
import fcntl, os
from dora import Node
lock = open(os.environ["DORA_INHIBIT_LOCK"], "a")
print(os.getpid(), "the arm is moving", file=lock, flush=True)
fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
print("locked", flush=True)
for event in Node():
    if event["type"] == "STOP":
        break
"""
FLOW = """
nodes:
  - id: arm
    path: arm.py
    inputs: {tick: dora/timer/millis/100}
"""


@contextmanager
def inhibiting(cell: Cell, *command: str) -> Iterator["subprocess.Popen[str]"]:
    """doractl inhibit, from the moment when it holds the lock."""
    words = ["doractl", cell.scope.flag, "inhibit", cell.name, "--why", "mission 12"]
    words += ["--", *command] if command else []
    child = subprocess.Popen(words, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_for("it is inhibited", lambda: cell.name in pids(cell).get(child.pid, ""))
        yield child
    finally:
        child.kill()
        child.communicate()


def pids(cell: Cell) -> dict[int, str]:
    """The dataflow by holder."""
    found = json.loads(cell.doractl("inhibit", "-o", "json").stdout)
    return {one["pid"]: one["name"] for one in found}


def refused(cell: Cell, *words: str) -> str:
    """What a refusal says; it changes nothing."""
    before = cell.show("InvocationID")
    done = cell.doractl(*words, check=False)
    assert (done.returncode, done.stdout) == (ExitCode.INHIBITED, "")
    assert cell.show("InvocationID") == before
    return done.stderr


@pytest.mark.lab
def test_a_node_in_the_sandbox_inhibits(cell: Cell, project: Project) -> None:
    """It has its own PID namespace, is not root, and its lock dies with it."""
    project.write("arm.py", ARM)
    flow = project.write("dataflow.yml", FLOW)
    cell.start(flow, "--sandbox", "strict", "--restart-policy", "no")
    wait_for("it is locked", lambda: "locked" in cell.messages("arm"))
    (arm,) = cell.pids("node-arm")
    said = refused(cell, "restart", cell.name)
    who = f"node arm (PID {arm}, user dora, python"
    assert f"cannot restart {cell.name}: inhibited by {who}" in said
    assert ": the arm is moving\nhint: --wait waits" in said
    assert f"cannot reload {cell.name}: inhibited by {who}" in refused(cell, "reload", cell.name)
    shown = cell.doractl("list", cell.name).stdout
    assert f"\nInhibit:  {who}" in shown
    assert f"\n  Inhibit:  {who}" in cell.doractl("why", cell.name).stdout
    row = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    (holder,) = row["inhibitors"]
    assert (holder["pid"], holder["node"], holder["why"]) == (arm, "arm", "the arm is moving")
    table = cell.doractl("inhibit").stdout.splitlines()
    assert table[0].split() == ["NAME", "NODE", "PID", "USER", "COMMAND", "WHY"]
    assert table[1].split()[:4] == [cell.name, "arm", str(arm), "dora"]
    cell.doractl("restart", cell.name, "--force")
    wait_for("it is locked again", lambda: cell.messages("arm").count("locked") == 2)
    assert arm not in pids(cell)
    cell.doractl("stop", cell.name)
    assert cell.doractl("inhibit").stdout == "No dataflow is inhibited.\n"


def test_a_command_inhibits(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    assert refused_without_reason(cell) == ExitCode.USAGE
    done = cell.doractl("inhibit", cell.name, "--why", "x", "--", "sh", "-c", "exit 7", check=False)
    assert done.returncode == 7
    with inhibiting(cell) as child:
        assert f"(PID {child.pid}, user " in refused(cell, "restart", cell.name)
        error = json.loads(refused(cell, "restart", cell.name, "-o", "json"))["error"]
        assert error["exit_status"] == ExitCode.INHIBITED
        assert error["message"].endswith(": mission 12")
        child.send_signal(signal.SIGKILL)
        child.wait()
        cell.doractl("restart", cell.name)  # the lock died with its holder
    assert [event["DORA_REASON"] for event in cell_events(cell)] == ["x", "mission 12"]


def refused_without_reason(cell: Cell) -> int:
    return cell.doractl("inhibit", cell.name, "--", "true", check=False).returncode


def cell_events(cell: Cell) -> list[dict[str, str]]:
    """The events of doractl inhibit about this dataflow."""
    uuid = f"DORA_DATAFLOW_NAME={cell.name}"
    lines = journalctl("-o", "json", "DORA_EVENT=inhibited", uuid).splitlines()
    return [json.loads(line) for line in lines]


def test_waiting_for_the_end_of_a_lock(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    before = cell.show("InvocationID")
    with inhibiting(cell, "sleep", "600") as child:
        words = ["doractl", cell.scope.flag, "restart", cell.name, "--wait"]
        waiting = subprocess.Popen(words, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert waiting.stderr
        assert "; waiting for its end" in waiting.stderr.readline()
        assert cell.show("InvocationID") == before
        child.send_signal(signal.SIGTERM)  # passed on to the command
        assert child.wait() == 128 + signal.SIGTERM
        told, _ = waiting.communicate()
        assert told.startswith("Dataflow restarted: ")
    assert cell.show("InvocationID") != before


def test_a_lock_holds_back_what_ends_single_nodes_or_everything(
    cell: Cell, project: Project
) -> None:
    cell.start(project.three_nodes())
    with inhibiting(cell):
        for action in ("restart", "stop"):
            told = refused(cell, "node", action, cell.name, "sink")
            assert f"cannot {action} node sink of {cell.name}: inhibited by" in told
        assert f"cannot stop {cell.name}: inhibited by" in refused(cell, "destroy")
    cell.doractl("destroy")
    assert cell.is_gone


def test_a_lock_outlasts_a_restart(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    with inhibiting(cell) as child:
        cell.doractl("restart", cell.name, "--force")
        wait_for("it is inhibited again", lambda: child.pid in pids(cell))
        refused(cell, "restart", cell.name)
        cell.doractl("stop", cell.name)  # no terminal: no question
        assert is_alive(child.pid)


def test_stop_asks_on_a_terminal(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    with inhibiting(cell):
        command = f"doractl {cell.scope.flag} stop {cell.name}"
        done = subprocess.run(
            ["script", "-qec", command, "/dev/null"],
            input="n\n",
            capture_output=True,
            text=True,
            check=False,
            timeout=bound(60),
        )
        assert f"Stop {cell.name} anyway? [y/N]" in done.stdout
        assert "mission 12" in done.stdout
        assert done.returncode == ExitCode.INHIBITED
        assert cell.show("ActiveState") == "active"


@pytest.mark.lab
def test_a_hostile_owner_only_harms_its_own(cell: Cell, project: Project) -> None:
    """A link, and a FIFO: root's doractl neither follows nor waits."""
    project.write("arm.py", ARM)
    cell.start(project.write("dataflow.yml", FLOW), "--uid", "alice")
    path = cell.paths.lock
    assert path.stat().st_uid == 1000
    secret = Path("/run/secret-of-root")
    secret.write_text("secret\n")
    try:
        run("runuser", "-u", "alice", "--", "ln", "-sfn", str(secret), str(path))
        done = cell.doractl("inhibit", cell.name, "--why", "x", "--", "true", check=False)
        assert done.returncode == ExitCode.BAD_INPUT
        assert f"cannot read {path}" in done.stderr
        assert secret.read_text() == "secret\n"
        os.mkfifo(path.with_name("fifo"))
        path.with_name("fifo").replace(path)
        done = cell.doractl("inhibit", cell.name, "--why", "x", "--", "true", check=False)
        assert done.returncode == ExitCode.BAD_INPUT
        assert cell.name in cell.doractl("list").stdout
        cell.doractl("restart", cell.name, "--force")
        assert path.is_file()
    finally:
        secret.unlink()
