"""The log path: lines into the journal, and out of it.  `python -m benchmarks.logs [ROUNDS]`

Rivals: a process that writes the same lines to journald itself, as fast as journald takes them,
`dora run` with its output into a file, and journalctl.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

from benchmarks.contestants import ENVIRONMENT
from benchmarks.flows import HOME, STAMP, clear_stamps, make_home, wait_stamps
from benchmarks.rounds import OURS, Figure, alternate, keep
from dora_systemd.adapters.cgroup.groups import group_path, read_cpu
from tests.system.cells import Cell, Project, run, sync_journal, wait_for

LINES = 200_000
FLOOD = f"""{STAMP}
import sys
Node()
if os.access("{HOME}/stamps", os.W_OK):
    stamp("ready")
lines = b"".join(b"%07d %s\\n" % (i, b"x" * 72) for i in range({LINES}))
sys.stdout.buffer.write(lines)
sys.stdout.flush()
"""
# The fields of ours, as far as they are of about the same size, one datagram a line.
SENDER = f"""
import socket
sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
sock.connect("/run/systemd/journal/socket")
fields = ("PRIORITY=6", "SYSLOG_IDENTIFIER=sender/flood", "DORA_DATAFLOW_NAME=sender",
    "DORA_DATAFLOW=550e8400-e29b-41d4-a716-446655440000", "DORA_NODE=flood", "DORA_NODE_PID=4711",
    "DORA_RUN=550e8400-e29b-41d4-a716-446655440000", "DORA_STREAM=stdout")
rest = "\\n".join(fields) + "\\n"
for i in range({LINES}):
    sock.send((f"MESSAGE={{i:07d}} {{'x' * 72}}\\n" + rest).encode())
"""
QUIET = """
import time
from dora import Node
node = Node()
for event in node:
    if event["type"] == "INPUT":
        print(time.time_ns() // 1000, flush=True)
"""
FLOW = "nodes: [{id: flood, path: flood.py}]"
SILENT = "nodes: [{id: flood, path: silent.py}]"
TICK = "{source: dora/timer/millis/20, queue_size: 100}"
TWO = f"nodes: [{{id: quiet, path: quiet.py, inputs: {{tick: {TICK}}}}}, FLOOD]"
NO_LIMIT = ("-p", "LogRateLimitIntervalSec=1s", "-p", "LogRateLimitBurst=500000000")


def times(*matches: str) -> list[int]:
    """When journald took the records that match, in µs."""
    sync_journal()
    command = ("journalctl", "-q", "-o", "json", "--output-fields=MESSAGE", *matches)
    lines = run(*command).stdout.splitlines()
    return [int(json.loads(line)["__REALTIME_TIMESTAMP"]) for line in lines]


def per_second(found: list[int]) -> float:
    """Lines a second, of all that were written."""
    assert len(found) == LINES, f"{len(found)} of {LINES} lines"
    return LINES / (found[-1] - found[0]) * 1e6


def ours_in(project: Project) -> float:
    """A node's lines, through its pipe and the runner."""
    cell = life(project, FLOW)
    return per_second(times(f"DORA_DATAFLOW_NAME={cell.name}", "DORA_STREAM=stdout"))


def life(project: Project, flow: str) -> Cell:
    """A dataflow that has ended by itself."""
    cell = Cell(f"bench-{time.time_ns()}")
    cell.start(project.write("flow.yml", flow))
    wait_for("it is over", lambda: cell.is_gone, 120)
    cell.end()
    return cell


def sender_in(project: Project) -> float:
    """The same lines from a service that speaks journald's protocol itself."""
    unit = f"sender-{time.time_ns()}.service"
    script = str(project.write("sender.py", SENDER))
    run("systemd-run", "--quiet", "--wait", "-u", unit, *NO_LIMIT, "python3", script)
    return per_second(times(f"_SYSTEMD_UNIT={unit}", "DORA_STREAM=stdout"))


def journald_busy(lines_in: Callable[[Project], float], project: Project) -> float:
    """% of a processor that journald uses while the lines come: 100 is as fast as it can."""
    before = journald_cpu()
    span = LINES / lines_in(project)
    return 100 * (journald_cpu() - before) / span


def journald_cpu() -> float:
    """Seconds that journald has used."""
    group = run("systemctl", "show", "--value", "-p", "ControlGroup", "systemd-journald").stdout
    return read_cpu(group_path(group.strip())).cpu_us / 1e6


def dora_in(project: Project) -> float:
    """The same lines through bare dora, into a file."""
    clear_stamps()
    dora_life(project, FLOW)
    ended = time.monotonic()
    (ready,) = wait_stamps("ready", 1)
    found = (HOME / "dora-run.log").read_bytes().count(b"x" * 72)
    assert found == LINES, f"{found} of {LINES} lines"
    return LINES / (ended - ready.at)


def dora_life(project: Project, flow: str) -> None:
    """A dataflow in `dora run` that has ended by itself."""
    command = ["dora", "run", str(project.write("flow.yml", flow))]
    with (HOME / "dora-run.log").open("wb") as log:
        environment = {**os.environ, **ENVIRONMENT}
        subprocess.run(command, stdout=log, stderr=log, env=environment, check=True)


def ours_cpu(project: Project) -> float:
    """µs of a processor for a line, journald's work left out."""
    return (ours_cpu_of(project, FLOW) - ours_cpu_of(project, SILENT)) / LINES


def ours_cpu_of(project: Project, flow: str) -> float:
    """µs that a unit has used in its life, from its cgroup as long as that is there."""
    cell = Cell(f"bench-{time.time_ns()}")
    cell.start(project.write("flow.yml", flow))
    used, group = 0, cell.group
    while now := read_cpu(group).cpu_us:
        used = now
        time.sleep(0.005)
    cell.end()
    return used


def dora_cpu(project: Project) -> float:
    """µs of a processor for a line in bare dora, its terminal left out."""
    return (dora_cpu_of(project, FLOW) - dora_cpu_of(project, SILENT)) / LINES


def dora_cpu_of(project: Project, flow: str) -> float:
    """µs that `dora run` and its nodes have used."""
    before = children_cpu()
    dora_life(project, flow)
    return children_cpu() - before


def children_cpu() -> float:
    """µs of all processes that have been waited for."""
    use = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (use.ru_utime + use.ru_stime) * 1e6


def reading(project: Project, output: str, rounds: int) -> Figure:
    """Printing what is in the journal."""
    cell = life(project, FLOW)
    sync_journal()
    matches = (f"DORA_DATAFLOW_NAME={cell.name}", "_TRANSPORT=journal")
    measures = {
        OURS: partial(seconds, "doractl", "logs", cell.name, "-o", output, "--no-pager"),
        "journalctl": partial(seconds, "journalctl", "-q", "-o", output, "--no-pager", *matches),
    }
    what = f"`logs -o {output}` of {LINES:,} lines"
    return alternate(what, "s", measures, rounds, goal="≤ 1.25 × journalctl")


def seconds(*command: str) -> float:
    """How long a command takes that prints to nowhere."""
    begun = time.monotonic()
    run("sh", "-c", 'exec "$@" >/dev/null', "sh", *command)
    return time.monotonic() - begun


def quiet_line(project: Project, with_flood: bool) -> float:
    """ms from a line of a quiet node to journald, the median of some 200."""
    flood = ", {id: flood, path: endless.py}" if with_flood else ""
    endless = FLOOD.replace("sys.stdout.buffer", "while True: sys.stdout.buffer")
    project.write("endless.py", endless)
    cell = Cell(f"quiet-{time.time_ns()}")
    cell.start(project.write("flow.yml", TWO.replace(", FLOOD", flood)))
    wait_for("200 lines", lambda: len(cell.messages("quiet")) > 200, 60)
    cell.end()
    found = cell.journal("DORA_NODE=quiet", "DORA_STREAM=stdout")
    records = [one for one in found if one["MESSAGE"].isdecimal()]
    late = [int(one["__REALTIME_TIMESTAMP"]) - int(one["MESSAGE"]) for one in records]
    return statistics.median(late) / 1000


def measure(rounds: int, want_all: bool = True) -> list[Figure]:
    """Lines in and out; beside a flood, and their cost, too, if all is wanted."""
    project = make_home()
    project.write("flood.py", FLOOD)
    project.write("silent.py", FLOOD.rpartition("lines =")[0])
    project.write("quiet.py", QUIET)
    own = "writes to journald itself"
    lines = {OURS: partial(ours_in, project), own: partial(sender_in, project)}
    lines |= {"dora run": partial(dora_in, project)}
    what, goal = "lines a second into the journal, one node", "≥ 0.95 × that service"
    figures = [alternate(what, "lines/s", lines, rounds, goal=goal)]
    figures.append(reading(project, "short", rounds))
    if want_all:
        busy = {OURS: partial(journald_busy, ours_in, project)}
        busy |= {own: partial(journald_busy, sender_in, project)}
        what = "journald's processor meanwhile: 100 % is all it can"
        figures.append(alternate(what, "%", busy, rounds))
        figures.append(reading(project, "cat", rounds))
        costs = {OURS: partial(ours_cpu, project), "dora run": partial(dora_cpu, project)}
        figures.append(alternate("CPU for a line, node included", "µs", costs, rounds))
        quiet = {OURS: partial(quiet_line, project, True)}
        quiet |= {"without the flood": partial(quiet_line, project, False)}
        figures.append(alternate("a quiet node's line beside a flood", "ms", quiet, rounds))
    return figures


if __name__ == "__main__":
    keep("logs", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 5)
