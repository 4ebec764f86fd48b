"""The log path: lines into the journal, and out of it. `python -m benchmarks.logs [ROUNDS]`.

Rivals: a process that writes the same lines to journald itself, as fast as journald takes them,
and journalctl.
"""

import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.rounds import Figure, alternate, report
from tests.system.cells import Cell, Project, run, sync_journal, wait_for

LINES = 200_000
FLOOD = f"""
import sys
from dora import Node
Node()
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
    cell = Cell(f"bench-{time.time_ns()}")
    cell.start(project.write("flow.yml", FLOW))
    wait_for("it is over", lambda: cell.is_gone, 120)
    found = times(f"DORA_DATAFLOW_NAME={cell.name}", "DORA_STREAM=stdout")
    cell.end()
    return per_second(found)


def rival_in(project: Project) -> float:
    """The same lines from a service that speaks journald's protocol itself."""
    unit = f"sender-{time.time_ns()}.service"
    script = str(project.write("sender.py", SENDER))
    run("systemd-run", "--quiet", "--wait", "-u", unit, *NO_LIMIT, "python3", script)
    return per_second(times(f"_SYSTEMD_UNIT={unit}", "DORA_STREAM=stdout"))


def reading(project: Project, output: str, rounds: int) -> Figure:
    """Printing what is in the journal."""
    cell = Cell(f"read-{time.time_ns()}")
    cell.start(project.write("flow.yml", FLOW))
    wait_for("it is over", lambda: cell.is_gone, 120)
    sync_journal()
    matches = (f"DORA_DATAFLOW_NAME={cell.name}", "_TRANSPORT=journal")
    ours = ("doractl", "logs", cell.name, "-o", output, "--no-pager")
    rival = ("journalctl", "-q", "-o", output, "--no-pager", *matches)
    what = f"`logs -o {output}` of {LINES:,} lines"
    figure = alternate(
        what, "s", lambda: seconds(*ours), "journalctl", lambda: seconds(*rival), rounds
    )
    cell.end()
    return figure


def seconds(*command: str) -> float:
    """How long a command takes that prints to nowhere."""
    begun = time.monotonic()
    run("sh", "-c", 'exec "$@" >/dev/null', "sh", *command)
    return time.monotonic() - begun


def quiet_line(project: Project, with_flood: bool) -> float:
    """ms from a line of a quiet node to journald, the median of some 200."""
    flood = "{id: flood, path: endless.py}" if with_flood else ""
    endless = FLOOD.replace("sys.stdout.buffer", "while True: sys.stdout.buffer")
    project.write("endless.py", endless)
    cell = Cell(f"quiet-{time.time_ns()}")
    cell.start(project.write("flow.yml", TWO.replace(", FLOOD", f", {flood}" if flood else "")))
    wait_for("200 lines", lambda: len(cell.messages("quiet")) > 200, 60)
    cell.end()
    found = cell.journal("DORA_NODE=quiet", "DORA_STREAM=stdout")
    records = [one for one in found if one["MESSAGE"].isdecimal()]
    late = [int(one["__REALTIME_TIMESTAMP"]) - int(one["MESSAGE"]) for one in records]
    return statistics.median(late) / 1000


def main(rounds: int) -> None:
    """Measure and report."""
    project = Project(Path(tempfile.mkdtemp(dir="/var/tmp")) / "bench")
    project.root.parent.chmod(0o755)
    project.write("flood.py", FLOOD)
    project.write("quiet.py", QUIET)
    figures = [
        alternate(
            "lines a second into the journal, one node",
            "lines/s",
            lambda: ours_in(project),
            "writes to journald itself",
            lambda: rival_in(project),
            rounds,
        ),
        reading(project, "short", rounds),
        reading(project, "cat", rounds),
        alternate(
            "a quiet node's line beside a flood",
            "ms",
            lambda: quiet_line(project, True),
            "without the flood",
            lambda: quiet_line(project, False),
            rounds,
        ),
    ]
    report("logs", figures)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
