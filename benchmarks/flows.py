"""The dataflow that is started, stopped and killed: one source, and sinks of what it sends.

Every node writes the time into a file, once it is ready and with its first input: CLOCK_MONOTONIC
is the same in all processes, so nothing has to be asked while the clock runs.
"""

import shutil
import time
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.system.cells import Project, command_line, run

CHECKOUT = Path(__file__).resolve().parents[1]
HOME = Path("/srv/bench")
STAMPS = HOME / "stamps"

STAMP = f"""
import os, time
from dora import Node
def stamp(what):
    with open("{STAMPS}/" + what + "-" + str(os.getpid()), "w") as file:
        file.write(str(time.monotonic_ns()))
"""
SOURCE = f"""{STAMP}
import pyarrow as pa
node, count = Node(), 0
stamp("ready")
for event in node:
    if event["type"] == "INPUT":
        node.send_output("number", pa.array([count]))
        count += 1
"""
SINK = f"""{STAMP}
import pyarrow as pa
node, has_input = Node(), False
stamp("ready")
for event in node:
    if event["type"] == "INPUT" and not has_input:
        has_input = bool(event["value"].to_pylist())
        stamp("input")
"""
SOURCE_YAML = """nodes:
  - {id: source, path: source.py, inputs: {tick: dora/timer/millis/10}, outputs: [number]}
"""
SINK_YAML = "  - {{id: sink-{}, path: sink.py, inputs: {{number: source/number}}}}\n"
STREAM_SENDER = """
import sys, time
from dora import Node
import pyarrow
size = int(sys.argv[1])
buffers = [None, pyarrow.py_buffer(bytes(size))]
node, data = Node(), pyarrow.Array.from_buffers(pyarrow.uint8(), size, buffers)
for event in node:
    if event["type"] == "INPUT":
        node.send_output("data", data, {"sent": time.monotonic_ns()})
"""
"""Sends so many bytes at each tick."""
STREAM_RECEIVER = """
import sys, time
from dora import Node
with open(sys.argv[1], "w", buffering=1) as file:
    for event in Node():
        if event["type"] == "INPUT":
            print(time.monotonic_ns() - event["metadata"]["sent"], file=file)
"""
"""Writes how long each message was on its way, in ns, into a file."""


class Stamp(NamedTuple):
    """what: "ready" or "input". at: seconds of CLOCK_MONOTONIC."""

    what: str
    pid: int
    at: float


@cache
def install_ours() -> None:
    """As users do: the lab's editable install imports through a finder, and compiles each time."""
    run("pip", "install", "--no-deps", "--no-build-isolation", "--quiet", str(CHECKOUT))


def make_home() -> Project:
    """A fresh directory for everything; what writes in it need not be root."""
    install_ours()
    shutil.rmtree(HOME, ignore_errors=True)
    project = Project(HOME)
    STAMPS.mkdir()
    STAMPS.chmod(0o777)
    project.write("source.py", SOURCE)
    project.write("sink.py", SINK)
    return project


def write_flow(project: Project, count: int) -> Path:
    """A dataflow of `count` Python nodes."""
    sinks = "".join(SINK_YAML.format(number) for number in range(1, count))
    return project.write(f"flow{count}.yml", SOURCE_YAML + sinks)


def clear_stamps() -> None:
    """Forget what was written so far."""
    for path in STAMPS.iterdir():
        path.unlink()


def read_stamps() -> list[Stamp]:
    """What was written so far, whole ones only."""
    found = []
    for path in STAMPS.glob("*-*"):
        what, _, pid = path.name.partition("-")
        if text := path.read_text():
            found.append(Stamp(what, int(pid), int(text) / 1e9))
    return found


def wait_stamps(what: str, count: int, seconds: float = 60.0) -> list[Stamp]:
    """The stamps as soon as there are `count` of a kind; AssertionError after `seconds`."""
    deadline = time.monotonic() + seconds
    while len(found := [stamp for stamp in read_stamps() if stamp.what == what]) < count:
        assert time.monotonic() < deadline, f"{len(found)} of {count} times {what}"
        time.sleep(0.005)
    return found


def wait_gone(pids: list[int], seconds: float = 60.0) -> None:
    """Return when none of the processes is there."""
    deadline = time.monotonic() + seconds
    while left := [pid for pid in pids if any(command_line(pid))]:
        assert time.monotonic() < deadline, f"still there: {left}"
        time.sleep(0.001)
