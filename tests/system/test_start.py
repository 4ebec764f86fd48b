"""doractl start and run: what they print, what they refuse, and that they leave nothing behind."""

import json
import os
import pwd
import re
import shutil
import signal
import subprocess
import uuid
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.scope import RUNTIME_NAME
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_for

TICK = "inputs: {tick: dora/timer/millis/50}"
EXITS = """
import sys
from dora import Node
node = Node()
print("bye", flush=True)
sys.exit(int(sys.argv[1]))
"""


def units() -> list[str]:
    """All units of dataflows that systemd knows."""
    listed = run("systemctl", "list-units", "--all", "--plain", "--no-legend", "dora-*.service")
    return [line.split()[0] for line in listed.stdout.splitlines()]


def uuid_of(printed: str) -> str:
    """The UUID in the first line of what start prints."""
    first = printed.splitlines()[0]
    assert first.startswith("Dataflow started: ")
    return str(uuid.UUID(first.rpartition(" ")[2]))


OTHERS = (
    r"doractl: alice, bob.* can log in and reach what the nodes exchange; "
    r"--network private prevents it, --network host accepts it\n"
)


def as_after_a_boot(cell: Cell) -> None:
    """Nothing has run yet; on a machine of its own, other users' dataflows are not touched."""
    if os.geteuid() == 0:
        shutil.rmtree(cell.scope.runtime_root / RUNTIME_NAME, ignore_errors=True)


def test_start_prints_what_users_know(cell: Cell, project: Project) -> None:
    as_after_a_boot(cell)
    done = cell.start(project.three_nodes())
    name = cell.name
    assert done.stdout == (
        f"Dataflow started: {uuid_of(done.stdout)}\n"
        f"Name: {name}\n"
        f"Unit: {cell.unit}\n"
        "\n"
        f"Use 'doractl stop {name}' to stop\n"
        "Use 'doractl list' to view status\n"
        f"Use 'doractl logs {name}' to view logs\n"
    )
    # The lab has two users besides. They are named once in each boot.
    assert re.fullmatch(OTHERS, done.stderr) or os.geteuid() != 0, done.stderr
    cell.end()
    assert cell.start(project.three_nodes()).stderr == ""


@pytest.mark.lab
@pytest.mark.parametrize("network", ["loopback", "private", "host"])
def test_start_tells_of_other_users_once(cell: Cell, project: Project, network: str) -> None:
    as_after_a_boot(cell)
    done = cell.start(project.three_nodes(), "--network", network)
    assert bool(re.fullmatch(OTHERS, done.stderr)) == (network == "loopback"), done.stderr


def test_start_as_json(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    started = json.loads(cell.start(flow, "-o", "json").stdout)
    assert started["name"] == cell.name
    assert started["unit"] == cell.unit
    assert started["details"]["file"] == str(flow)
    assert started["uuid"] in cell.show("ExecStart")


def test_without_a_file_it_is_dataflow_yml_here(cell: Cell, project: Project) -> None:
    project.three_nodes()
    run("doractl", "start", "--name", cell.name, cwd=project.root)
    assert cell.show("ActiveState") == "active"


def test_stages_are_shown_on_a_terminal_only(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    shell = f"doractl start {flow} --name {cell.name}"
    shown = run("script", "--quiet", "--command", shell, "/dev/null", stdin=subprocess.DEVNULL)
    assert "nodes ready" in shown.stdout
    assert "Dataflow started" in shown.stdout.rpartition("\x1b[K")[2]


# Its end comes before or after dora has started the node.
@pytest.mark.warns("Signal(15)")
def test_no_wait(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", "nodes: [{id: never, path: sleep, args: '100'}]")
    done = cell.start(flow, "--no-wait")
    assert done.stdout.startswith("Dataflow starting: ")
    assert cell.show("ActiveState") == "activating"


def test_dry_run_starts_nothing(cell: Cell, project: Project) -> None:
    done = cell.start(project.three_nodes(), "--dry-run", "--property", "Nice=5")
    assert done.stdout.startswith(f"# {cell.unit}\n")
    assert "\nNice=5\n" in done.stdout
    assert cell.unit not in units()


def test_dry_run_is_a_unit_that_systemd_accepts(
    cell: Cell, project: Project, tmp_path: Path
) -> None:
    text = cell.start(project.three_nodes(), "--dry-run", "--env", "A=b c $d %n").stdout
    unit = tmp_path / cell.unit
    unit.write_text(text)
    assert run("systemd-analyze", "verify", str(unit)).stderr == ""


def test_a_name_in_use_is_refused(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    first = uuid_of(cell.start(flow).stdout)
    pids = cell.all_pids()
    again = cell.start(flow, check=False)
    assert again.returncode == ExitCode.NAME_IN_USE
    assert first in again.stderr
    assert str(flow) in again.stderr
    assert cell.all_pids() == pids


@pytest.mark.warns("exit code 3", "ExitCode(3)", "Failed with result 'exit-code'")
def test_a_failed_name_is_replaced_and_its_logs_stay(cell: Cell, project: Project) -> None:
    project.write("exits.py", EXITS)
    flow = project.write("bad.yml", "nodes: [{id: one, path: exits.py, args: '3'}]")
    cell.start(flow, check=False)
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed")
    old = cell.show("ExecStart")
    cell.start(project.three_nodes())
    assert cell.show("ActiveState") == "active"
    assert cell.show("ExecStart") != old
    wait_for("its words are kept", lambda: "bye" in cell.messages("one"))


@pytest.mark.lab
def test_a_foreign_unit_is_left_alone(cell: Cell, project: Project) -> None:
    run("systemd-run", "--quiet", f"--unit={cell.unit}", "sleep", "100")
    done = cell.start(project.three_nodes(), check=False)
    assert done.returncode == ExitCode.NAME_IN_USE
    assert cell.show("ActiveState") == "active"


@pytest.mark.lab
def test_the_owner_of_the_file_runs_it(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    shutil.chown(flow, "alice")
    cell.start(flow)
    assert cell.show("User") == "alice"
    uids = {Path(f"/proc/{pid}").stat().st_uid for pid in cell.all_pids()}
    assert uids == {pwd.getpwnam("alice").pw_uid}


@pytest.mark.lab
def test_root_only_when_asked_for(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    assert "User=dora\n" in cell.start(flow, "--dry-run").stdout
    assert "User=root\n" in cell.start(flow, "--dry-run", "--uid", "root").stdout


@pytest.mark.lab
def test_a_file_of_somebody_else_cannot_choose_root(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    beside = project.write("dataflow.systemd.yml", "user: root\n")
    shutil.chown(beside, "alice")
    done = cell.start(flow, "--dry-run", check=False)
    assert done.returncode == ExitCode.NO_PERMISSION
    shutil.chown(beside, "root")
    assert "User=root\n" in cell.start(flow, "--dry-run").stdout


@pytest.mark.lab
def test_a_directory_that_the_user_cannot_enter(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.root.chmod(0o700)
    done = cell.start(flow, "--uid", "bob", check=False)
    assert done.returncode == ExitCode.NO_PERMISSION
    assert "bob" in done.stderr
    assert str(flow) in done.stderr
    assert cell.unit not in units()


def test_environment(cell: Cell, project: Project) -> None:
    script = (
        "import os\nfrom dora import Node\nnode = Node()\n"
        "print(*(os.environ[key] for key in 'ABCJP'), flush=True)\n"
        "for event in node: pass\n"
    )
    project.write("shows.py", script)
    file = project.write("variables", "A=file\nB='from file'\n# comment\nJ={\"a\": 1}\n")
    place = "env: {P: '${PWD}/lib'}"
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: shows.py, {TICK}, {place}}}]")
    cell.start(flow, "--env-file", str(file), "--env", "A=flag", "--env", "C=50% of $HOME")
    line = f'flag from file 50% of $HOME {{"a": 1}} {project.root}/lib'
    wait_for("it prints", lambda: line in cell.messages("one"))


@pytest.mark.warns("exit code 1", "ExitCode(1)", "Failed", "No module", "Traceback", "File ")
def test_a_failed_start_says_why(cell: Cell, project: Project) -> None:
    project.write("bad.py", "import nosuchmodule\n")
    flow = project.write("bad.yml", "nodes: [{id: one, path: bad.py}]")
    done = cell.start(flow, check=False)
    assert done.returncode == ExitCode.FAILURE
    *words, message, hint = done.stderr.splitlines()
    assert "  one: ModuleNotFoundError: No module named 'nosuchmodule'" in words
    assert message == f"doractl: cannot start {cell.name}: node one: exit code 1"
    flag = cell.scope.flag
    check = f"check logs: doractl {flag} logs {cell.name} --node one"
    assert hint == f"hint: {check}; doractl {flag} why {cell.name} shows more"


# As above.
@pytest.mark.warns("Signal(15)")
def test_ctrl_c_while_it_starts_ends_the_waiting_only(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", "nodes: [{id: never, path: sleep, args: '100'}]")
    command = ("doractl", "start", str(flow), "--name", cell.name)
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for("it starts", lambda: cell.show("ActiveState") == "activating")
    child.send_signal(signal.SIGINT)
    _, said = child.communicate(timeout=bound(10))
    assert child.returncode == ExitCode.INTERRUPTED, said
    assert f"doractl: interrupted; {cell.name} is still starting\nhint: " in said
    assert cell.show("ActiveState") == "activating"


@pytest.mark.parametrize("seconds", [0, 2])
def test_the_daemon_is_started_ahead_and_once(cell: Cell, project: Project, seconds: int) -> None:
    """Also after a coordinator that takes longer to listen than the daemon is held ready for."""
    slow = f'[ "$1" = coordinator ] && sleep {seconds}\nexec {shutil.which("dora")} "$@"\n'
    dora = project.write("dora", f"#!/bin/sh\n{slow}")
    dora.chmod(0o755)
    cell.start(project.three_nodes(), f"--dora={dora}")
    assert cell.supervisor_pid("daemon")
    assert len(cell.pids("supervisor")) == 3
