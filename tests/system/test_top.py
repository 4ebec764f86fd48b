"""doractl top: what runs uses, once, as JSON, and live on a terminal."""

import json
import re
import shlex
import subprocess
from collections.abc import Iterator

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run, wait_for
from tests.system.terminal import Screen, Tmux

BUSY = """
import threading
from dora import Node
def spin():
    while True:
        pass
threading.Thread(target=spin, daemon=True).start()
for event in Node():
    pass
"""


def test_no_dataflow() -> None:
    done = run("doractl", "top")
    assert (done.stdout, done.stderr) == ("No dataflow is running.\n", "")
    assert json.loads(run("doractl", "top", "--once", "-o", "json").stdout)["dataflows"] == []


def test_one_reading(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", BUSY)
    cell.start(flow)
    header, *lines = cell.doractl("top", cell.name).stdout.splitlines()
    assert header.split()[:4] == ["NAME", "STATE", "UPTIME", "CPU%"]
    assert lines[0].startswith(f"{cell.name}  Running 3/3")
    # By CPU: the node that never rests stands first.
    assert re.match(r"  sink +Running +00:00:\d\d +\d\d", lines[1])
    assert {line.split()[0] for line in lines[1:]} == {"source", "doubler", "sink"}
    by_name = cell.doractl("top", "--once", "--sort", "name").stdout.splitlines()
    assert [line.split()[0] for line in by_name[2:]] == ["source", "doubler", "sink"]


@pytest.fixture
def tmux() -> Iterator[Tmux]:
    with Tmux(80, 12) as terminal:
        yield terminal


def start_top(tmux: Tmux, cell: Cell, *options: str) -> None:
    tmux.press(shlex.join(["doractl", cell.scope.flag, "top", cell.name, *options]), "Enter")
    tmux.wait("  sink")


@pytest.mark.warns("failed to receive reply from daemon", "Signal(15)")
def test_keys_restart_and_stop(cell: Cell, project: Project, tmux: Tmux) -> None:
    def pid() -> int:
        return cell.status.nodes["doubler"].pid

    cell.start(project.three_nodes())
    start_top(tmux, cell, "--interval", "0.2", "--sort", "name")
    tmux.press("?")
    tmux.wait("select a row")
    tmux.press("x", "Down", "Down", "R")
    tmux.wait(f"Restart node doubler of {cell.name}? y/n")
    before = pid()
    tmux.press("n")
    tmux.wait("q quit")
    tmux.press("R", "y")
    tmux.wait("Node restarting: doubler")
    wait_for("another process", lambda: pid() not in (0, before))
    tmux.press("Home", "R", "y")
    tmux.wait("Dataflow restarted: ", seconds=60)
    tmux.press("S")
    tmux.wait(f"Stop {cell.name}? y/n")
    tmux.press("y", "q")
    tmux.wait("Dataflow stopped: ", seconds=60)
    assert cell.is_gone


class TestWhatRuns:
    """All of them look at the same dataflow."""

    def test_objects_go_on(self, running: Cell) -> None:
        command = ["doractl", running.scope.flag, "top", "-o", "json", "--interval", "0.2"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout
            looks = [json.loads(child.stdout.readline()) for _ in range(3)]
            child.terminate()
        assert looks[0]["at_us"] < looks[1]["at_us"] < looks[2]["at_us"]
        (row,) = looks[2]["dataflows"]
        assert (row["name"], row["nodes_alive"]) == (running.name, 3)
        assert 0 < row["cpu_percent"] < 800
        assert {node["node"]: node["state"] for node in row["nodes"]} == dict.fromkeys(
            ("source", "doubler", "sink"), "running"
        )
        # Containers may have no pressure files; where they are, all three are.
        assert set(row["waits_percent"] or ()) in ({"cpu", "memory", "io"}, set())

    @pytest.mark.parametrize("key", ["q", "C-c"])
    def test_live(self, key: str, running: Cell, tmux: Tmux) -> None:
        tmux.press("before=$(stty -a); echo ready", "Enter")
        tmux.wait("\nready")
        start_top(tmux, running, "--interval", "0.2", "--sort", "name")
        title, header, *rows = tmux.lines()
        assert re.match(r"\d\d:\d\d:\d\d  1 dataflow, 3 nodes, CPU [\d.]+%, memory ", title)
        assert header.split()[:4] == ["NAME", "STATE", "UPTIME", "CPU%"]
        assert re.match(rf"{running.name[:6]}.* +Running 3/3", rows[0])
        assert [row.split()[0] for row in rows[1:4]] == ["source", "doubler", "sink"]
        assert rows[-1].startswith("q quit")
        wait_for("the next second", lambda: tmux.lines()[0] > title)
        tmux.press(key)
        assert "ready" in tmux.wait_prompt(), "the screen before it is back"
        assert not any("doubler" in line for line in tmux.lines())
        tmux.press('test "$(stty -a)" = "$before" && echo as before', "Enter")
        tmux.wait("\nas before")

    def test_any_size(self, running: Cell, tmux: Tmux) -> None:
        start_top(tmux, running, "--sort", "name")
        for columns, rows in ((60, 12), (200, 5), (60, 3), (30, 2), (100, 30)):
            tmux.resize(columns, rows)

            def is_whole() -> bool:
                lines = tmux.lines()
                seen = sum(running.name[:6] in line for line in lines)
                return "q quit" in lines[-1] and seen == 1

            wait_for(f"one line for one row, and the last line at {columns}x{rows}", is_whole)
        tmux.resize(60, 4)
        tmux.press("End")
        assert "sink" in "".join(tmux.wait("4-4/4"))
        tmux.press("PPage")
        assert "doubler" in "".join(tmux.wait("3-3/4"))
        tmux.press("Home")
        assert running.name[:6] in "".join(tmux.wait("1-1/4"))
        tmux.press("q")

    def test_suspended(self, running: Cell, tmux: Tmux) -> None:
        start_top(tmux, running)
        tmux.press("C-z")
        assert not any("doubler" in line for line in tmux.wait("Stopped"))
        tmux.press("fg", "Enter")
        tmux.wait("q quit")
        tmux.press("q")
        tmux.wait_prompt()

    @pytest.mark.parametrize("term", ["dumb", "nosuch"])
    def test_other_terminals(self, term: str, running: Cell) -> None:
        command = ["env", f"TERM={term}", "doractl", running.scope.flag, "top", running.name]
        seen = Screen(command)
        status = seen.end()
        if term == "dumb":
            assert (status, seen.lines()[0].split()[0]) == (0, "NAME")
        else:
            assert status == ExitCode.FAILURE
            assert seen.lines()[0].startswith("doractl: cannot use the terminal nosuch: ")
            assert seen.lines()[1].startswith("hint: ")

    def test_what_is_not_there(self, running: Cell) -> None:
        done = running.doractl("top", running.name[:-1], check=False)
        assert done.returncode == ExitCode.NOT_FOUND
        assert f"did you mean {running.name}" in done.stderr
