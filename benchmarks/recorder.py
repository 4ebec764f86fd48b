"""What it costs a consumer that its messages are recorded.  `python -m benchmarks.recorder [N]`

One dataflow, whose recorder is switched on and off in turns while it runs, so that all turns have
the same processes. 1 MB goes 30 times a second, 64 B 500 times; the consumer measures the latency.
In the turns of the rival a node receives the same messages and drops them: what dora itself needs
for one more receiver.
"""

import json
import statistics
import sys
import time
from functools import partial
from pathlib import Path

from benchmarks.cost import cpu_seconds, private_mb
from benchmarks.flows import STAMPS, STREAM_RECEIVER, STREAM_SENDER, clear_stamps, make_home
from benchmarks.rounds import OURS, Figure, keep, shown, take_turns
from tests.system.cells import Cell, Project, run, wait_for

SECONDS = 6.0
RECORD = "last=10s,memory=200M"
RECORDER = "node-dora-systemd-recorder"
STREAMS = {"1 MB at 30 Hz": (1_000_000, 33), "64 B at 500 Hz": (64, 2)}
"""Bytes of a message, and milliseconds between two."""
STREAM = """
  - {{id: sender-{size}, path: sender.py, args: "{size}",
     inputs: {{tick: dora/timer/millis/{pause}}}, outputs: [data]}}
  - {{id: receiver-{size}, path: receiver.py, args: "{file}",
     inputs: {{data: {{source: sender-{size}/data, queue_size: 100}}}}}}
"""
WITHOUT, DROPPED = "not recorded", "a node that drops them"
DROPS_ID, DROPS_FILE, QUEUE = "drops", "drops.py", 4
DROPS_GROUP = f"node-{DROPS_ID}"
DROPS = """
from dora import Node
for event in Node():
    del event
"""


def stamps(size: int) -> Path:
    """Where the receiver of a stream writes the latencies, in ns."""
    return STAMPS / str(size)


def count(size: int) -> int:
    """How many latencies there are."""
    return stamps(size).read_bytes().count(b"\n") if stamps(size).exists() else 0


def flow(project: Project, *, drops: bool = False) -> Path:
    """The dataflow with both streams, and with the node that drops them."""
    parts = [
        STREAM.format(size=size, pause=pause, file=stamps(size)) for size, pause in STREAMS.values()
    ]
    if drops:
        sources = (f"sender-{size}/data" for size, _ in STREAMS.values())
        inputs = {f"{at}": {"source": one, "queue_size": QUEUE} for at, one in enumerate(sources)}
        node = {"id": DROPS_ID, "path": DROPS_FILE, "inputs": inputs}
        parts.append(f"  - {json.dumps(node)}\n")
    return project.write("recorder.yml", "nodes:" + "".join(parts))


def change(cell: Cell, project: Project, contestant: str) -> None:
    """Have the dataflow run with the recorder, with the node that drops, or with neither."""
    cell.doractl("set", cell.name, "--record", "off")
    flow(project, drops=contestant == DROPPED)
    cell.doractl("reload", cell.name)
    wait_for("the last recorder ends", lambda: not cell.pids(RECORDER))
    is_there = contestant == DROPPED
    wait_for("the node that drops", lambda: bool(cell.pids(DROPS_GROUP)) is is_there)
    if contestant == OURS:
        cell.doractl("set", cell.name, "--record", RECORD)
        wait_for("the recorder", lambda: cell.pids(RECORDER))


def turn(
    cell: Cell, project: Project, costs: list[tuple[float, float]], contestant: str
) -> list[float]:
    """µs on the way of each stream."""
    change(cell, project, contestant)
    time.sleep(2)  # its first seconds are a start
    begins = {size: count(size) for size, _ in STREAMS.values()}
    before = [cpu_seconds(pid) for pid in cell.pids(RECORDER)]
    time.sleep(SECONDS)
    if contestant == OURS:
        (pid,) = cell.pids(RECORDER)
        costs.append((private_mb(pid), 100 * (cpu_seconds(pid) - before[0]) / SECONDS))
    return [median_from(size, begin) for size, begin in begins.items()]


def median_from(size: int, begin: int) -> float:
    """Of the latencies of a stream from number `begin` on, in µs."""
    lines = stamps(size).read_text().split("\n")[begin:-1]
    return statistics.median(int(line) / 1000 for line in lines)


def measure(rounds: int) -> list[Figure]:
    """Latency of both streams; memory and CPU time of the recorder."""
    project, costs = make_home(), list[tuple[float, float]]()
    clear_stamps()
    project.write("sender.py", STREAM_SENDER)
    project.write("receiver.py", STREAM_RECEIVER)
    project.write(DROPS_FILE, DROPS)
    cell = Cell("recorder")
    words = ("--writable", str(STAMPS), "--name", cell.name, "--record", RECORD)
    run("doractl", "start", str(flow(project)), *words)
    wait_for("messages flow", lambda: all(count(size) for size, _ in STREAMS.values()))
    names = (OURS, WITHOUT, DROPPED)
    contestants = {name: partial(turn, cell, project, costs, name) for name in names}
    found = take_turns(contestants, rounds)
    cell.end()
    return [shown(one) for one in figures(found, costs)]


def figures(found: dict[str, list[list[float]]], costs: list[tuple[float, float]]) -> list[Figure]:
    """The lines of the table."""
    lines = [
        Figure(
            f"latency of {name} beside the recorder",
            "µs",
            {who: [one[number] for one in turns] for who, turns in found.items()},
            "≤ 1.10",
        )
        for number, name in enumerate(STREAMS)
    ]
    memory, cpu = zip(*costs, strict=True)
    lines.append(Figure("private memory of the recorder", "MB", {OURS: list(memory)}))
    lines.append(Figure("CPU of the recorder", "%", {OURS: list(cpu)}))
    return lines


if __name__ == "__main__":
    keep("recorder", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 20)
