"""doractl top: what runs uses, once, as JSON, and live on a terminal."""

import json
import os
import re
import subprocess

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run
from tests.system.terminal import on_terminal, read_until

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


def test_objects_go_on(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    command = ["doractl", cell.scope.flag, "top", "-o", "json", "--interval", "0.2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        looks = [json.loads(child.stdout.readline()) for _ in range(3)]
        child.terminate()
    assert looks[0]["at_us"] < looks[1]["at_us"] < looks[2]["at_us"]
    (row,) = looks[2]["dataflows"]
    assert (row["name"], row["nodes_alive"]) == (cell.name, 3)
    assert 0 < row["cpu_percent"] < 800
    assert {node["node"]: node["state"] for node in row["nodes"]} == dict.fromkeys(
        ("source", "doubler", "sink"), "running"
    )
    # Containers may have no pressure files; where they are, all three are.
    assert set(row["waits_percent"] or ()) in ({"cpu", "memory", "io"}, set())


@pytest.mark.parametrize("key", [b"q", b"\x03"])
def test_live(key: bytes, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    command = ["doractl", cell.scope.flag, "top", "--interval", "0.2"]
    pid, fd = on_terminal(command, LINES="20", COLUMNS="120")
    seen = read_until(fd, lambda text: text.count("doractl top") > 3 and "  sink" in text)
    assert seen.startswith("\x1b[?1049h")
    assert re.search(rf"{cell.name} +Running 3/3", seen)
    os.write(fd, key)
    end = read_until(fd, lambda text: "\x1b[?1049l" in text)
    assert end.endswith("\x1b[?25h\x1b[?1049l")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_what_is_not_there(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    done = cell.doractl("top", cell.name[:-1], check=False)
    assert done.returncode == ExitCode.NOT_FOUND
    assert f"did you mean {cell.name}" in done.stderr
