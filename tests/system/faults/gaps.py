"""Longest pause in the messages after a fault: the column "gap" of docs/production.md.

tests/lab/lab run -- python -m tests.system.faults.gaps 3
"""

import os
import signal
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from tests.lab.pace import pace
from tests.system.cells import Cell, Project, run, wait_for

NAME, HOME = "gaps", Path("/srv/gaps")
TIMES = HOME / "notes/times"
SOURCE = """
from dora import Node
import pyarrow as pa
node = Node()
for event in node:
    if event["type"] == "INPUT":
        node.send_output("number", pa.array([1]))
"""
SINK = f"""
from dora import Node
import time
node = Node()
for event in node:
    if event["type"] == "INPUT":
        with open("{TIMES}", "a") as file:
            print(time.time(), file=file)
"""
FLOW = """nodes:
  - {id: source, path: source.py, inputs: {tick: dora/timer/millis/20}, outputs: [number]}
  - {id: sink, path: sink.py, inputs: {number: source/number}}
"""
SETTINGS = """restart_policy: on-failure
writable: [notes]
venv: /opt/lab
nodes: {source: {owes: {output: number, within: 2s}}}
"""


def signal_node(number: signal.Signals) -> None:
    """Send a signal to the process of the source."""
    os.kill(Cell(NAME).status.nodes["source"].pid, number)


def kill_part(part: str) -> Callable[[], None]:
    """Return what kills the runner, the coordinator or the daemon."""
    return lambda: os.kill(Cell(NAME).supervisor_pid(part), signal.SIGKILL)


FAULTS: dict[str, Callable[[], object]] = {
    "a node is killed": lambda: signal_node(signal.SIGKILL),
    "a node hangs": lambda: signal_node(signal.SIGSTOP),
    "the daemon is killed": kill_part("daemon"),
    "the coordinator is killed": kill_part("coordinator"),
    "the runner is killed": kill_part("runner"),
    "all of them are killed": lambda: run("systemctl", "kill", "--signal=KILL", f"dora-{NAME}"),
}


def read_times() -> list[float]:
    """When the sink has received a message, as far as lines are whole."""
    return [float(one) for one in TIMES.read_text().split("\n")[:-1]] if TIMES.exists() else []


def gap_of(fault: Callable[[], object]) -> float:
    """Start the dataflow, apply the fault, and return the longest pause that follows."""
    TIMES.unlink(missing_ok=True)
    run("doractl", "start", str(HOME / "dataflow.yml"), "--name", NAME)
    wait_for("messages", lambda: len(read_times()) > 50)
    start = time.time()
    fault()

    def gaps() -> list[tuple[float, float]]:
        after = [at for at in read_times() if at > start - 0.5]
        return sorted((later - sooner, later) for sooner, later in pairwise(after))

    def is_over() -> bool:
        """Whether a pause is there, and messages have come for a second since."""
        found = gaps()
        return bool(found) and found[-1][0] > 0.3 and read_times()[-1] > found[-1][1] + 1

    wait_for("messages after the fault", is_over, 60)
    run("doractl", "stop", NAME)
    return gaps()[-1][0]


def main(rounds: int) -> None:
    """Print the median of each fault, and how slow the machine was."""
    project = Project(HOME)
    notes = TIMES.parent
    notes.mkdir()
    notes.chmod(0o777)
    for name, text in (("source.py", SOURCE), ("sink.py", SINK), ("dataflow.yml", FLOW)):
        project.write(name, text)
    project.write("dataflow.systemd.yml", SETTINGS)
    for name, fault in FAULTS.items():
        found = [gap_of(fault) for _ in range(rounds)]
        shown = ", ".join(f"{one:.1f}" for one in found)
        print(f"{name}: {statistics.median(found):.1f} s ({shown}), pace {pace():.1f}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
