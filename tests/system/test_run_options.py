"""What `dora run`, `dora start` and `dora stop` take, doractl takes: options and variables."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.terminal import Screen

SPEAKER = """
from dora import Node
node = Node()
print("raw", flush=True)
node.log("warn", "careful")
node.log("info", "all is well")
for event in node:
    if event["type"] == "STOP":
        break
"""
STUBBORN = """
import signal, time
from dora import Node
node = Node()
signal.signal(signal.SIGTERM, signal.SIG_IGN)
while True:
    time.sleep(1)
"""
pytestmark = pytest.mark.warns("careful")

TICK = "inputs: {tick: dora/timer/millis/50}"


@pytest.fixture
def speaker(project: Project) -> Path:
    project.write("speaker.py", SPEAKER)
    return project.write("dataflow.yml", f"nodes: [{{id: speaker, path: speaker.py, {TICK}}}]\n")


def test_stop_after(cell: Cell, speaker: Path) -> None:
    begin = time.monotonic()
    done = cell.doractl("run", str(speaker), "--name", cell.name, "--stop-after", "2s")
    assert time.monotonic() - begin >= 2
    assert "raw" in done.stdout
    assert cell.is_gone


@pytest.mark.parametrize(
    ("words", "variables", "shown"),
    [
        ((), {}, {"raw", "careful", "all is well"}),
        (("--log-level", "info"), {}, {"careful", "all is well"}),
        ((), {"DORA_LOG_LEVEL": "warn"}, {"careful"}),
        (("--log-level", "error", "--log-filter", "speaker=warn"), {}, {"careful"}),
        ((), {"DORA_LOG_FILTER": "speaker=error"}, set()),
    ],
)
def test_levels(
    cell: Cell, speaker: Path, words: tuple[str, ...], variables: dict[str, str], shown: set[str]
) -> None:
    command = ("doractl", "--system", "run", str(speaker), "--name", cell.name, *words)
    env = {**os.environ, **variables, "DORA_LOG_FORMAT": "json"}
    done = run(*command, "--stop-after", "3s", env=env)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    said = {one["message"] for one in lines if one["node_id"] == "speaker"}
    assert said & {"raw", "careful", "all is well"} == shown
    assert {one["dataflow_id"] for one in lines} <= {lines[0]["dataflow_id"] if lines else ""}


@pytest.mark.warns("Failed with result 'signal'", "code=killed", "was killed", "Killing process")
def test_logs_go_on_after_a_restart(cell: Cell, speaker: Path) -> None:
    words = ("--restart-policy", "on-failure", "--restart-delay", "500ms")
    command = ["doractl", "--system", "run", str(speaker), "--name", cell.name, *words]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    wait_for("it speaks", lambda: "raw" in cell.messages("speaker"))
    os.kill(cell.supervisor_pid("runner"), signal.SIGKILL)
    wait_for("it speaks again", lambda: cell.messages("speaker").count("raw") == 2)
    child.send_signal(signal.SIGINT)
    out, _ = child.communicate(timeout=bound(30))
    assert out.count("raw") == 2


def attach(cell: Cell, flow: Path) -> "subprocess.Popen[str]":
    command = ("doractl", "--system", "start", str(flow), "--name", cell.name, "--attach")
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_for("it runs", lambda: cell.show("ActiveState") == "active")
    return child


def test_attach_ends_with_ctrl_c(cell: Cell, speaker: Path) -> None:
    child = attach(cell, speaker)
    wait_for("it prints", lambda: cell.messages("speaker"))
    child.send_signal(signal.SIGINT)
    out, _ = child.communicate(timeout=bound(30))
    assert child.returncode == 0
    assert "raw" in out
    assert cell.is_gone


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_an_attached_dataflow_goes_on(cell: Cell, speaker: Path, how: signal.Signals) -> None:
    child = attach(cell, speaker)
    child.send_signal(how)
    child.communicate(timeout=bound(30))
    assert cell.show("ActiveState") == "active"


def test_a_dynamic_node_is_announced(cell: Cell, project: Project) -> None:
    project.write("speaker.py", SPEAKER)
    nodes = f"nodes: [{{id: one, path: speaker.py, {TICK}}}, {{id: cam, path: dynamic}}]\n"
    done = cell.start(project.write("dataflow.yml", nodes))
    assert f'eval "$(doractl --system env {cell.name})"' in done.stderr
    cell.doractl("stop", "-n", cell.name)


@pytest.mark.warns("killed", "Signal(9)", "Failed with result", "Killing process")
@pytest.mark.parametrize("words", [("--force",), ("--grace-duration", "1s")])
def test_stop_in_a_hurry(cell: Cell, project: Project, words: tuple[str, ...]) -> None:
    project.write("stubborn.py", STUBBORN)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: stubborn.py, {TICK}}}]\n")
    cell.start(flow, "--grace-duration", "60s")
    begin = time.monotonic()
    done = cell.doractl("stop", cell.name, *words)
    assert time.monotonic() - begin < bound(15)
    assert done.stdout.endswith(f"({cell.name}): killed\n")
    assert cell.is_gone


def test_stop_asks_on_a_terminal(cell: Cell, project: Project) -> None:
    other = Cell(f"{cell.name}-2")
    for one in (cell, other):
        one.start(project.three_nodes())
    refused = run("doractl", "--system", "stop", check=False, stdin=subprocess.DEVNULL)
    assert refused.stderr.startswith("doractl: cannot stop: give names or --all\nhint: ")
    unseen = Screen(["sh", "-c", "doractl --system stop 2>/dev/null"])
    assert unseen.end() == ExitCode.USAGE, "nobody would see the question"
    screen = Screen(["doractl", "--system", "stop"])
    wait_for("it asks", lambda: "Number or name" in "".join(screen.lines()))
    screen.press(f"{other.name}\n".encode())
    assert screen.end() == 0
    assert other.is_gone
    screen = Screen(["doractl", "--system", "forget", other.name])
    screen.press(b"n\n")
    assert screen.end() == ExitCode.FAILURE
    assert "doractl: nothing was removed" in "".join(screen.lines())
    assert not cell.is_gone
    screen = Screen(["doractl", "--system", "stop"])
    assert screen.end() == 0
    assert cell.is_gone
