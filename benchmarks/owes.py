"""What it costs to watch an output: 1 MB, 30 times a second.  `python -m benchmarks.owes [N]`

The same dataflow with `owes` and without, both at the same time, so that the machine is the same
for both. The receiver measures the latency; memory and CPU time are those of the probe's process.
"""

import json
import statistics
import sys
import time
from pathlib import Path

from benchmarks.cost import cpu_seconds, private_mb
from benchmarks.flows import STAMPS, STREAM_RECEIVER, STREAM_SENDER, clear_stamps, make_home
from benchmarks.rounds import OURS, Figure, keep, shown
from dora_systemd.decisions.cell.extra import PROBE
from tests.system.cells import Cell, Project, run, wait_for

SECONDS = 10.0
YAML = """nodes:
  - {{id: sender, path: sender.py, args: "1000000",
     inputs: {{tick: dora/timer/millis/33}}, outputs: [data]}}
  - {{id: receiver, path: receiver.py, args: {file}, inputs: {{data: sender/data}}}}
"""
PLAIN = "not watched"
FLAGS = {OURS: ("--node", "sender:owes=data:within=5s"), PLAIN: ()}


def stamps(name: str) -> Path:
    """Where the receiver of a contestant writes the latencies, in ns."""
    return STAMPS / name.replace(" ", "-")


def start(project: Project, name: str) -> Cell:
    """Start one of the two dataflows, and wait until messages flow and the probe hears them."""
    flow = project.write(f"{stamps(name).name}.yml", YAML.format(file=stamps(name)))
    cell = Cell(flow.stem)
    settings = ("--writable", str(STAMPS), *FLAGS[name])
    run("doractl", "start", str(flow), "--name", cell.name, *settings)
    wait_for("messages flow", lambda: stamps(name).exists() and stamps(name).read_text())
    return cell


def latencies(name: str, begin: int) -> list[float]:
    """In µs, of the lines from number `begin` on."""
    return [int(line) / 1000 for line in stamps(name).read_text().split()[begin:]]


def measure(rounds: int) -> list[Figure]:
    """Latency of both; memory and CPU time of the probe."""
    project = make_home()
    clear_stamps()
    project.write("sender.py", STREAM_SENDER)
    project.write("receiver.py", STREAM_RECEIVER)
    cells = {name: start(project, name) for name in FLAGS}
    ours = cells[OURS]
    wait_for("it is heard", lambda: has_age(ours))
    (probe,) = ours.pids(f"node-{PROBE}")
    found: dict[str, list[float]] = {name: [] for name in FLAGS}
    cpu: list[float] = []
    for _ in range(rounds):
        begins = {name: len(latencies(name, 0)) for name in FLAGS}
        before = cpu_seconds(probe)
        time.sleep(SECONDS)
        cpu.append(100 * (cpu_seconds(probe) - before) / SECONDS)
        for name, begin in begins.items():
            found[name].append(statistics.median(latencies(name, begin)))
    memory = private_mb(probe)
    for cell in cells.values():
        cell.end()
    return [
        shown(Figure("latency of 1 MB at 30 Hz, while it is watched", "µs", found, "≤ 1.15")),
        shown(Figure("private memory of the probe", "MB", {OURS: [memory]}, "≤ 25 MB")),
        shown(Figure("CPU of the probe at 30 Hz of 1 MB", "%", {OURS: cpu}, "≤ 2 %")),
    ]


def has_age(cell: Cell) -> bool:
    """Whether the probe has heard the sender."""
    row = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    return any(one["age_us"] is not None for node in row["nodes"] for one in node["outputs"])


if __name__ == "__main__":
    keep("owes", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 6)
