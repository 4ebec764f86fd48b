"""Nodes that say of themselves that they are alive: watchdogs, STATUS=, and who is believed."""

import json
import math
import time

import pytest

from dora_systemd.decisions.watchdog.messages import parse_sign
from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, wait_for
from tests.system.gateways import Front
from tests.system.refusals import Refusal, check_refusals

ON_FAILURE = ("--restart-policy", "on-failure", "--max-restarts", "3")
ENDED = ("is ended by its watchdog", "was ended", "is being restarted", "node exited with error")

# As in dora-systemd-nodes(7), without a library.
SAY = """
import os, socket
def say(text, place=os.environ["NOTIFY_SOCKET"]):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
        notify.sendto(text.encode(), place)
"""
FEEDER = f"""
import pathlib, time
from dora import Node
{SAY}
assert os.environ["WATCHDOG_PID"] == str(os.getpid())
for event in Node():
    say("STATUS=\\x1b[31m{{}} us\\nWATCHDOG=1".format(os.environ["WATCHDOG_USEC"]))
    if pathlib.Path("silent").read_text() == str(os.getpid()):
        time.sleep(3600)
"""
# The programs that people use instead: one by a child process, one by systemd's library.
OTHERS = {
    "shell": "subprocess.run(['systemd-notify', 'WATCHDOG=1', '--status=by a program'])",
    "library": "sd.sd_notify(0, b'WATCHDOG=1\\nSTATUS=by a library')",
}
OTHER = """
import ctypes, subprocess
from dora import Node
sd = ctypes.CDLL("libsystemd.so.0")
assert sd.sd_watchdog_enabled(0, None) == 1
for event in Node():
    {}
"""
# A node that hangs, and does not even end by SIGABRT.
VICTIM = """
import signal, time
from dora import Node
signal.signal(signal.SIGABRT, signal.SIG_IGN)
node = Node()
print("runs", flush=True)
while True:
    time.sleep(3600)
"""
# A node that ends by SIGABRT, and a child of it that does not.
PARENT = """
import subprocess, time
from dora import Node
node = Node()
subprocess.Popen(["sh", "-c", "trap '' ABRT; exec sleep 3600"], start_new_session=True)
time.sleep(3600)
"""
IDLE = """
from dora import Node
for event in Node():
    pass
"""
LIAR = f"""
import pathlib
from dora import Node
{SAY}
own = pathlib.Path(os.environ["NOTIFY_SOCKET"])
assert "WATCHDOG_USEC" not in os.environ
for event in Node():
    say("STATUS=I am fine")
    say("WATCHDOG=1\\nSTATUS=victim is fine", str(own.with_name("victim.notify")))
    say("WATCHDOG=trigger\\nSTATUS=feeder is not", str(own.with_name("feeder.notify")))
"""


def write_flow(project: Project, **programs: str) -> str:
    """A dataflow of nodes that a timer wakes, each with its program."""
    for name, text in programs.items():
        project.write(f"{name}.py", text)
    project.write("silent", "")
    inputs = "inputs: {tick: dora/timer/millis/200}"
    nodes = [f"  - {{id: {one}, path: {one}.py, {inputs}}}\n" for one in programs]
    return str(project.write("flow.yml", "nodes:\n" + "".join(nodes)))


def limit() -> int:
    """Seconds in which a healthy node of this test sends its sign on this machine."""
    return math.ceil(bound(2))


def texts(cell: Cell) -> dict[str, str]:
    """What each node says of itself, as `list` shows it."""
    found = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    return {one["node"]: one["text"] for one in found["nodes"]}


def signs(cell: Cell, node: str) -> int:
    """CLOCK_MONOTONIC µs of the last sign of life."""
    return parse_sign(cell.status.signs[node]).at_us


@pytest.mark.warns(*ENDED)
@pytest.mark.lab
@pytest.mark.usefixtures("gateway_up")
def test_a_node_that_falls_silent_is_restarted(front: Front, cell: Cell, project: Project) -> None:
    others = {name: OTHER.format(line) for name, line in OTHERS.items()}
    flow = project.root / write_flow(project, feeder=FEEDER, **others)
    seconds = limit()
    cell.start(flow, f"--watchdog={seconds}s", *ON_FAILURE)
    said = {
        "feeder": f"[31m{seconds}000000 us",
        "shell": "by a program",
        "library": "by a library",
    }
    wait_for("all say what they do", lambda: texts(cell) == said)
    before = {node: cell.pids(f"node-{node}")[0] for node in said}

    # All of the cell stands still, for longer than the watchdog allows: nobody has missed anything.
    # Not for much longer: the unit has a watchdog too, of 30 s.
    cell.systemctl("kill", "--signal=SIGSTOP", "--kill-whom=all")
    since = time.monotonic()
    wait_for("time passes", lambda: time.monotonic() - since > seconds + 2)
    cell.systemctl("kill", "--signal=SIGCONT", "--kill-whom=all")
    last = time.monotonic() * 1e6
    wait_for("they go on", lambda: all(signs(cell, node) > last for node in said))
    assert "node-watchdog" not in dict(cell.events())

    project.write("silent", str(before["feeder"]))
    wait_for("it is ended", lambda: ("node-watchdog", "feeder") in cell.events())
    wait_for("it is back", lambda: ("node-restarted", "feeder") in cell.events())
    wait_for("it says so", lambda: texts(cell) == said)
    records = cell.journal("DORA_NODE=feeder")
    events = {one["DORA_EVENT"]: one for one in records if "DORA_EVENT" in one}
    missed = f"no WATCHDOG=1 for {seconds}s"
    assert events["node-watchdog"]["MESSAGE"].endswith(f"by its watchdog: {missed}")
    assert events["node-watchdog"]["DORA_STATUS"] == said["feeder"]
    assert events["node-ended"]["DORA_EXIT"] == f"hung, {missed}"
    assert "Fatal Python error: Aborted" in cell.messages("feeder")
    assert cell.pids("node-feeder") != [before["feeder"]]
    assert [cell.pids(f"node-{one}")[0] for one in OTHERS] == [before[one] for one in OTHERS]
    assert f"feeder 1 (hung, {missed})" in cell.doractl("why", cell.name).stdout
    table = cell.doractl("list", cell.name).stdout
    assert "STATUS TEXT" in table
    assert f"s/{seconds}s  by a library" in table

    labels = f'{{dataflow="{cell.name}",node="shell"}}'
    metrics = dict(line.rsplit(" ", 1) for line in front.get("/metrics")[1].splitlines())
    assert float(metrics[f"dora_node_watchdog_seconds{labels}"]) == seconds
    assert 0 <= float(metrics[f"dora_node_watchdog_age_seconds{labels}"]) < seconds


@pytest.mark.warns(*ENDED, "got a message from another process")
def test_no_node_speaks_for_another(cell: Cell, project: Project) -> None:
    seconds = limit()
    own = f"{{watchdog: {seconds}s}}"
    project.write("flow.systemd.yml", f"nodes: {{victim: {own}, feeder: {own}}}")
    flow = project.root / write_flow(project, liar=LIAR, victim=VICTIM, feeder=FEEDER)
    strict = ("--sandbox=strict", "--network=private", "--notify", "--grace-duration=1s")
    cell.start(flow, *ON_FAILURE, *strict)
    (feeder,) = cell.pids("node-feeder")
    wait_for("it is ended", lambda: ("node-watchdog", "victim") in cell.events())
    wait_for("it is killed", lambda: ("node-restarted", "victim") in cell.events())
    assert texts(cell) == {"liar": "I am fine", "victim": None, "feeder": f"[31m{seconds}000000 us"}
    refused = [node for event, node in cell.events() if event == "notify-refused"]
    assert sorted(refused) == ["feeder", "victim"], "each is reported once a minute"
    (record, *_) = cell.journal("DORA_EVENT=notify-refused")
    assert record["DORA_SENDER"] == str(cell.pids("node-liar")[0])
    assert cell.pids("node-feeder") == [feeder]


@pytest.mark.warns(*ENDED)
def test_nothing_is_left_of_a_node_that_is_not_restarted(cell: Cell, project: Project) -> None:
    project.write("flow.systemd.yml", f"nodes: {{parent: {{watchdog: {limit()}s}}}}")
    cell.start(project.root / write_flow(project, parent=PARENT, idle=IDLE))
    wait_for("it has failed", lambda: ("node-ended", "parent") in cell.events())
    wait_for("nothing is left of it", lambda: not cell.pids("node-parent"))
    assert cell.status.nodes["parent"].state == "failed"
    assert cell.status.nodes["idle"].state == "running"


BAD = {
    "--watchdog=5": ExitCode.USAGE,
    "--watchdog=-1s": ExitCode.USAGE,
    "--node=feeder:watchdog=10ms": ExitCode.USAGE,
    "--watchdog=soon": ExitCode.USAGE,
    "--node=feder:watchdog=5s": ExitCode.BAD_INPUT,
}


def test_bad_watchdogs(cell: Cell, project: Project) -> None:
    flow = write_flow(project, feeder=FEEDER)
    parts = {ExitCode.USAGE: "watchdog", ExitCode.BAD_INPUT: "did you mean feeder?"}
    check_refusals(cell, project, [Refusal([flow, one], BAD[one], parts[BAD[one]]) for one in BAD])


def test_a_dataflow_without_watchdogs_has_no_sockets(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    assert not list(cell.paths.io.glob("*.notify"))
    assert cell.status.signs == {}
