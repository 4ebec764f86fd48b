"""doractl run: a dataflow that lives no longer than its terminal."""

import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.lab.pace import bound
from tests.system.cells import Cell, Project, is_alive, sync_journal, wait_for
from tests.system.terminal import Screen

TICK = "inputs: {tick: dora/timer/millis/50}"
STUBBORN = """
import signal, time
from dora import Node
node = Node()
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("stubborn", flush=True)
while True:
    time.sleep(1)
"""
EXITS = """
import sys
from dora import Node
node = Node()
print("bye", flush=True)
sys.exit(int(sys.argv[1]))
"""


def run_attached(cell: Cell, flow: Path) -> "subprocess.Popen[str]":
    command = ("doractl", "run", str(flow), "--name", cell.name)
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_for("it runs", lambda: cell.show("ActiveState") == "active")
    return child


def test_run_ends_with_ctrl_c(cell: Cell, project: Project) -> None:
    child = run_attached(cell, project.three_nodes())
    wait_for("it prints", lambda: cell.messages("sink"))
    child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=bound(30))
    assert (child.returncode, err) == (0, "")
    assert "got [" in out
    assert "stopped" in out.splitlines()[-1]
    assert cell.is_gone
    sync_journal()
    assert "(doractl run)\n" in cell.doractl("why", cell.name).stdout


LAST_WORDS = """
from dora import Node
for event in Node():
    if event["type"] == "STOP":
        for number in range(4):
            print("last", number, flush=True)
"""
FLOOD = """
from dora import Node
node = Node()
node.next()
while True:
    print("x" * 60, flush=True)
"""


def run_on_screen(cell: Cell, project: Project, node: str, *words: str) -> Screen:
    project.write("one.py", node)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: one.py, {TICK}}}]\n")
    screen = Screen(["doractl", "run", str(flow), "--name", cell.name, *words])
    wait_for("it runs", lambda: cell.show("ActiveState") == "active")
    return screen


def test_run_on_a_terminal_is_clean_and_prints_to_the_end(cell: Cell, project: Project) -> None:
    screen = run_on_screen(cell, project, LAST_WORDS)
    screen.press(b"\x03")
    assert screen.end() == 0
    lines = screen.lines()
    assert [line[-6:] for line in lines if "last" in line] == [f"last {n}" for n in range(4)]
    when = re.compile(r"(\^C)?[A-Z][a-z]{2} \d\d \d\d:\d\d:\d\d ")
    notes = ("doractl: ", "^C")
    assert not [one for one in lines if not when.match(one) and not one.startswith(notes)], lines


@pytest.mark.warns("Signal(9)", "Signal(15)", "was killed", "failed to receive", "suppressed")
def test_run_hears_ctrl_c_in_a_flood(cell: Cell, project: Project) -> None:
    screen = run_on_screen(cell, project, FLOOD, "--grace-duration", "1s")
    screen.pause = 0.02
    wait_for("it floods", lambda: len(screen.lines()) > 100)
    screen.press(b"\x03")
    wait_for("it stops", lambda: cell.show("ActiveState") != "active", 10)
    screen.end()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_run_takes_the_dataflow_with_it(cell: Cell, project: Project, how: signal.Signals) -> None:
    child = run_attached(cell, project.three_nodes())
    pids = cell.all_pids()
    child.send_signal(how)
    child.communicate(timeout=bound(30))
    wait_for("it has ended", lambda: cell.is_gone)
    assert not [pid for pid in pids if is_alive(pid)]
    assert ("dataflow-stopped", "") in cell.events()


def press_again(cell: Cell, child: "subprocess.Popen[str]") -> bool:
    """Ctrl+C as a person presses it: again, while nothing happens. Whether it has ended."""
    if cell.show("ActiveState") == "deactivating":
        child.send_signal(signal.SIGINT)
    return child.poll() is not None


@pytest.mark.warns("code=killed", "Failed with result 'signal'", "Killing process", "was killed (")
def test_second_ctrl_c_kills(cell: Cell, project: Project) -> None:
    project.write("stubborn.py", STUBBORN)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: stubborn.py, {TICK}}}]")
    child = run_attached(cell, flow)
    child.send_signal(signal.SIGINT)
    wait_for("it stops", lambda: cell.show("ActiveState") == "deactivating")
    wait_for("it ends", lambda: press_again(cell, child), 5)
    child.communicate()
    assert child.returncode == 128 + signal.SIGKILL
    assert cell.is_gone


@pytest.mark.warns("exit code 3", "ExitCode(3)", "Failed with result 'exit-code'")
@pytest.mark.parametrize(("status", "expected"), [(0, 0), (3, 1)])
def test_exit_status_of_run(cell: Cell, project: Project, status: int, expected: int) -> None:
    project.write("exits.py", EXITS)
    flow = project.write("dataflow.yml", f"nodes: [{{id: one, path: exits.py, args: '{status}'}}]")
    done = cell.doractl("run", str(flow), "--name", cell.name, check=False)
    assert done.returncode == expected
    assert "bye" in done.stdout
    wait_for("nothing is left of it", lambda: cell.show("LoadState") == "not-found")
