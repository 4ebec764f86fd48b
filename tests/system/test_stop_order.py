"""Nodes that stop in an order, each in its own time: a recorder loses nothing, others end as usual.

dora would kill the recorder in the middle of its work: that takes two grace durations.
"""

import json
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound, pace
from tests.system.cells import Cell, Project, run, sync_journal, wait_for
from tests.system.test_signs import SAY

SOURCE = """
import time
from dora import Node
node, sent = Node(), 0
for event in node:
    if event["type"] == "INPUT":
        sent += 1
        node.send_output("out", str(sent).encode())
print("ends", time.monotonic_ns(), sent, flush=True)
"""
# It needs some seconds to write what it has received: the last message of each source. The first
# messages of a run can be lost, with dora as well, so it says so when it has received many.
RECORDER = f"""
import json, pathlib, time
from dora import Node
{SAY}
seconds, extend = float(pathlib.Path("seconds").read_text()), pathlib.Path("extend").exists()
last, run, records = {{}}, time.monotonic_ns(), False
for event in Node():
    if event["type"] == "INPUT" and event["id"] != "tick":
        last[event["id"]] = int(bytes(event["value"].to_pylist()))
        if not records and min(last.get("camera", 0), last.get("arm", 0)) > 50:
            records = True
            print("records", flush=True)
    elif event["type"] == "STOP":
        told = time.monotonic_ns()  # what waits in the queues follows
part = pathlib.Path(f"saved/episode-{{run}}.part")
begun = time.monotonic()
while (left := begun + seconds - time.monotonic()) > 0:
    say("STATUS=writing episode")
    if extend:
        say("EXTEND_TIMEOUT_USEC=1000000")
    with part.open("a") as file:
        file.write("x" * 1000)
    time.sleep(0.05)
part.write_text(json.dumps({{**last, "told": told}}))
part.rename(part.with_suffix(".json"))
"""
FLOW = """
nodes:
  - {id: camera, path: source.py, inputs: {t: dora/timer/millis/20}, outputs: [out]}
  - {id: arm, path: source.py, inputs: {t: dora/timer/millis/20}, outputs: [out]}
  - id: recorder
    path: recorder.py
    inputs:
      camera: {source: camera/out, queue_size: 1000}
      arm: {source: arm/out, queue_size: 1000}
      tick: dora/timer/millis/100
"""
STOPS = int(os.environ.get("STOPS", "4"))
STOP = "{within: 100s, after: [camera, arm]}"
CRASHES = ("exited because of signal", "node exited with error", "process was killed on drop")


def flow(project: Project, stop: str = STOP, seconds: int = 0) -> Path:
    """The dataflow, whose recorder needs `seconds`, or twice the grace duration."""
    grace = round(2 * max(pace(), 1))
    project.write("seconds", str(seconds or 2 * grace))
    project.write("source.py", SOURCE)
    project.write("recorder.py", RECORDER)
    settings = (
        f"grace_duration: {grace}s\nwritable: [saved]\nnodes:\n  recorder: {{stop: {stop}}}\n"
    )
    project.write("flow.systemd.yml", settings)
    saved = project.root / "saved"
    saved.mkdir(exist_ok=True)
    saved.chmod(0o777)  # the nodes run as another user
    return project.write("flow.yml", FLOW)


def episodes(project: Project) -> list[dict[str, int]]:
    """What the recorder has saved; a file that is not complete fails the test."""
    assert not list(project.root.glob("saved/*.part")), "the recorder was killed"
    return [
        json.loads(one.read_text()) for one in sorted(project.root.glob("saved/episode-*.json"))
    ]


def start(cell: Cell, dataflow: Path) -> None:
    cell.start(dataflow)
    wait_for("it records", lambda: "records" in cell.messages("recorder"))


def ends(cell: Cell, node: str) -> list[tuple[int, int]]:
    """When the source ended each time, and how much it had sent."""
    lines = (one.split() for one in cell.messages(node))
    return [(int(line[1]), int(line[2])) for line in lines if line[0] == "ends"]


def check_saved(cell: Cell, project: Project, stops: int) -> None:
    """The last that was sent is in a file, of each life of the dataflow."""
    saved = episodes(project)
    assert len(saved) == stops
    pairs = zip(ends(cell, "camera"), ends(cell, "arm"), strict=True)
    for episode, (camera, arm) in zip(saved, pairs, strict=True):
        assert (episode["camera"], episode["arm"]) == (camera[1], arm[1])
        assert max(camera[0], arm[0]) <= episode["told"]


@pytest.mark.lab
def test_the_recorder_is_told_last_and_has_its_time(cell: Cell, project: Project) -> None:
    start(cell, flow(project))
    assert cell.show("TimeoutStopUSec") == "5min 10s"
    begun = time.monotonic_ns()
    done = cell.doractl("stop", cell.name)
    assert "killed" not in done.stdout
    check_saved(cell, project, 1)
    last = max(ends(cell, node)[0][0] for node in ("camera", "arm"))
    assert last - begun < bound(3) * 1e9, "the others end as fast as ever"


@pytest.mark.lab
def test_stops_of_all_kinds_lose_nothing(cell: Cell, project: Project) -> None:
    """STOPS=100 for more of them."""
    dataflow = flow(project)
    start(cell, dataflow)
    for number in range(1, STOPS + 1):
        if number % 4 == 0:
            cell.systemctl("restart")
        elif number % 4 == 1:
            cell.doractl("restart", cell.name)
        else:
            cell.systemctl("stop") if number % 4 == 2 else cell.doractl("stop", cell.name)
            cell.start(dataflow)
        assert len(episodes(project)) == number
        wait_for("it records", lambda: _records(cell) > number)  # noqa: B023 - called at once
    cell.doractl("stop", cell.name)
    check_saved(cell, project, STOPS + 1)


def _records(cell: Cell) -> int:
    return cell.messages("recorder").count("records")


@pytest.mark.lab
@pytest.mark.warns(
    *CRASHES, "crashed: signal SIGKILL", "failed: essential node", "Failed with result"
)
def test_a_failure_elsewhere_keeps_the_order(cell: Cell, project: Project) -> None:
    dataflow = flow(project)
    settings = project.root / "flow.systemd.yml"
    project.write("flow.systemd.yml", settings.read_text() + "  camera: {essential: yes}\n")
    start(cell, dataflow)
    (pid,) = [one.pid for node, one in cell.status.nodes.items() if node == "camera"]
    run("kill", "-KILL", str(pid))
    wait_for("it ends", lambda: cell.is_gone)
    (episode,) = episodes(project)
    assert ends(cell, "arm")[0][0] <= episode["told"]


@pytest.mark.lab
def test_more_time_as_long_as_the_node_asks_for_it(cell: Cell, project: Project) -> None:
    dataflow = flow(project, "{within: 1s, after: [camera, arm]}")
    project.write("extend", "")
    start(cell, dataflow)
    cell.doractl("stop", cell.name)
    assert len(episodes(project)) == 1


@pytest.mark.lab
@pytest.mark.warns(*CRASHES, "has not stopped in its time")
def test_a_node_that_does_not_ask_is_ended_in_its_time(cell: Cell, project: Project) -> None:
    start(cell, flow(project, "1s", seconds=60))
    begun = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - begun < bound(5)
    assert list(project.root.glob("saved/*.part")), "SIGTERM came after a second"
    sync_journal()
    why = cell.doractl("why", cell.name).stdout
    assert re.search("; not stopped in their time: .*recorder", why)


@pytest.mark.lab
@pytest.mark.warns(*CRASHES, "was killed (SIGKILL)", "status=9/KILL", "Failed with result")
@pytest.mark.parametrize("how", ["now", "interrupt"])
def test_who_cannot_wait(cell: Cell, project: Project, how: str) -> None:
    start(cell, flow(project, seconds=60))
    command = ["doractl", cell.scope.flag, "stop", cell.name]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as first:
        wait_for("it writes", lambda: list(project.root.glob("saved/*.part")))
        begun = time.monotonic()
        if how == "now":
            cell.doractl("stop", "--now", cell.name)
        else:
            first.send_signal(signal.SIGINT)
            assert first.stderr is not None
            assert "Ctrl+C again" in first.stderr.readline()
            assert list(project.root.glob("saved/*.part")), "the first one only says so"
            first.send_signal(signal.SIGINT)
        first.wait(bound(30))
    assert time.monotonic() - begun < bound(10)
    wait_for("it is gone", lambda: cell.is_gone)
    assert list(project.root.glob("saved/*.part"))


@pytest.mark.lab
def test_what_it_waits_for_is_shown(cell: Cell, project: Project) -> None:
    start(cell, flow(project, seconds=10))
    with subprocess.Popen(["doractl", cell.scope.flag, "stop", cell.name]) as first:
        wait_for("it writes", lambda: list(project.root.glob("saved/*.part")))
        shown = wait_for("its status", lambda: _list_with(cell, "writing"))
        assert "Stopping (recorder: writing episode, " in shown
        assert "s left)" in shown
        first.wait(bound(40))


def _list_with(cell: Cell, word: str) -> str:
    shown = cell.doractl("list", cell.name).stdout
    return shown if word in shown else ""


REFUSED = [
    ("{after: [camra]}", "cannot stop recorder after the node 'camra': no such node"),
    ("{after: [recorder]}", "cannot stop recorder after recorder: that is a circle"),
    ("{within: 10min}", "cannot give the node recorder 10min to stop: "),
    ("{within: 5}", "cannot read the stop of a node: within is '5'"),
]


@pytest.mark.parametrize(("stop", "words"), REFUSED, ids=["name", "circle", "limit", "unit"])
def test_what_cannot_be_is_refused_before_anything_starts(
    cell: Cell, project: Project, stop: str, words: str
) -> None:
    done = cell.start(flow(project, stop), check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert words in done.stderr
    assert "hint: " in done.stderr
    sync_journal()
    assert not cell.journal()
