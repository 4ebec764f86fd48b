"""Nodes that stop in an order, each in its own time: a recorder loses nothing, others end as usual.

The grace duration is so short that dora would kill the recorder in the middle of its work.
"""

import json
import time
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.lab.pace import bound
from tests.system.cells import Cell, Project, run, sync_journal, wait_for
from tests.system.test_signs import SAY

SOURCE = """
import time
from dora import Node
node, sent = Node(), 0
for event in node:
    if event["type"] == "INPUT":
        node.send_output("out", b"1")
        sent += 1
print("ends", time.monotonic_ns(), sent, flush=True)
"""
# It needs three seconds to write what it has received, and counts what it was given.
RECORDER = f"""
import json, pathlib, time
from dora import Node
{SAY}
seconds, extend = 3.0, pathlib.Path("extend").exists()
seen, run = 0, time.monotonic_ns()
print("records", flush=True)
for event in Node():
    if event["type"] == "INPUT" and event["id"] != "tick":
        seen += 1
    if event["type"] == "STOP":
        break
told = time.monotonic_ns()
part = pathlib.Path(f"saved/episode-{{run}}.part")
begun = time.monotonic()
while (left := begun + seconds - time.monotonic()) > 0:
    say("STATUS=writing episode")
    if extend:
        say("EXTEND_TIMEOUT_USEC=1000000")
    with part.open("a") as file:
        file.write("x" * 1000)
    time.sleep(0.05)
part.write_text(json.dumps({{"seen": seen, "told": told}}))
part.rename(part.with_suffix(".json"))
"""
FLOW = """
nodes:
  - {id: camera, path: source.py, inputs: {t: dora/timer/millis/20}, outputs: [out]}
  - {id: arm, path: source.py, inputs: {t: dora/timer/millis/20}, outputs: [out]}
  - id: recorder
    path: recorder.py
    inputs:
      a: {source: camera/out, queue_size: 1000}
      b: {source: arm/out, queue_size: 1000}
      tick: dora/timer/millis/100
"""
STOP = "{within: 20s, after: [camera, arm]}"
CRASHES = ("exited because of signal", "node exited with error", "process was killed on drop")


def flow(project: Project, stop: str = STOP, more: str = "") -> Path:
    project.write("source.py", SOURCE)
    project.write("recorder.py", RECORDER)
    settings = (
        f"grace_duration: 1s\nwritable: [saved]\n{more}nodes:\n  recorder: {{stop: {stop}}}\n"
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
    """All that was sent is in a file, of each life of the dataflow."""
    saved = episodes(project)
    assert len(saved) == stops
    pairs = zip(ends(cell, "camera"), ends(cell, "arm"), strict=True)
    for episode, (camera, arm) in zip(saved, pairs, strict=True):
        assert episode["seen"] == camera[1] + arm[1], "everything that they sent was there"
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
    assert last - begun < bound(2) * 1e9, "the others end as fast as ever"


@pytest.mark.lab
def test_twenty_stops_of_all_kinds_lose_nothing(cell: Cell, project: Project) -> None:
    dataflow = flow(project)
    start(cell, dataflow)
    for number in range(1, 21):
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
    check_saved(cell, project, 21)


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
@pytest.mark.warns(*CRASHES)
def test_a_node_that_does_not_ask_is_ended_in_its_time(cell: Cell, project: Project) -> None:
    start(cell, flow(project, "1s"))
    begun = time.monotonic()
    cell.doractl("stop", cell.name)
    assert time.monotonic() - begun < bound(3)
    assert list(project.root.glob("saved/*.part")), "SIGTERM came after a second"


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
