"""A dataflow whose recorder needs longer for its stop than the others, and what it has saved."""

import json
from pathlib import Path
from typing import Any

from tests.lab.pace import pace
from tests.system.cells import Cell, Project, wait_for
from tests.system.test_signs import SAY
from tests.unit.fakes.recorder.mcap import File

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
# It needs some seconds to write what it has received, the last message of each source, and goes on
# while there is a file `hold`. The first messages of a run can be lost, with dora as well, so it
# says so when it has received many.
RECORDER = f"""
import json, pathlib, time
from dora import Node
{SAY}
seconds, extend = float(pathlib.Path("seconds").read_text()), pathlib.Path("extend").exists()
last, closed, run, records = {{}}, {{}}, time.time_ns(), False
for event in Node():
    if event["type"] == "INPUT" and event["id"] != "tick":
        last[event["id"]] = int(bytes(event["value"].to_pylist()))
        if not records and min(last.get("camera", 0), last.get("arm", 0)) > 50:
            records = True
            print("records", flush=True)
    elif event["type"] == "INPUT_CLOSED":
        closed[event["id"]] = last.get(event["id"])
    elif event["type"] == "STOP":
        told = time.monotonic_ns()  # what waits in the queues follows
part = pathlib.Path(os.environ["SAVED"], f"episode-{{run}}.part")
hold, end = part.with_name("hold"), time.monotonic() + seconds
while time.monotonic() < end or hold.exists():
    say("STATUS=writing episode")
    if extend:
        say("EXTEND_TIMEOUT_USEC=1000000")
    with part.open("a") as file:
        file.write("x" * 1000)
    time.sleep(0.05)
part.write_text(json.dumps({{**last, "told": told, "closed": closed}}))
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
STOP = "{within: 100s, after: [camera, arm]}"
CRASHES = ("exited because of signal", "node exited with error", "process was killed on drop")


def saved(project: Project) -> Path:
    """Where the recorder saves: beside the project, of which a release would be a copy."""
    return project.root.parent / "saved"


def parts(project: Project) -> list[Path]:
    """The files that are not complete."""
    return list(saved(project).glob("*.part"))


def flow(project: Project, stop: str = STOP, seconds: int = 0) -> Path:
    """The dataflow, whose recorder needs `seconds`, or twice the grace duration."""
    grace, place = round(2 * max(pace(), 1)), saved(project)
    project.write("seconds", str(seconds or 2 * grace))
    project.write("source.py", SOURCE)
    project.write("recorder.py", RECORDER)
    head = f"grace_duration: {grace}s\nwritable: [{place}]\nenv: {{SAVED: {place}}}\n"
    project.write("flow.systemd.yml", f"{head}nodes:\n  recorder: {{stop: {stop}}}\n")
    place.mkdir(exist_ok=True)
    place.chmod(0o777)  # the nodes run as another user
    return project.write("flow.yml", FLOW)


def episodes(project: Project) -> list[dict[str, Any]]:
    """What the recorder has saved; a file that is not complete fails the test."""
    assert not parts(project), "the recorder was killed"
    return [json.loads(one.read_text()) for one in sorted(saved(project).glob("episode-*.json"))]


def start(cell: Cell, dataflow: Path) -> None:
    cell.start(dataflow)
    wait_for("it records", lambda: records(cell))


def records(cell: Cell) -> int:
    """How often the recorder has begun to record."""
    return cell.messages("recorder").count("records")


def ends(cell: Cell, node: str) -> list[tuple[int, int]]:
    """When the source ended each time, and how much it had sent."""
    lines = (one.split() for one in cell.messages(node))
    return [(int(line[1]), int(line[2])) for line in lines if line[0] == "ends"]


def is_overtaken(episode: dict[str, Any], node: str, sent: int) -> bool:
    """Whether dora has closed the recorder's input before the last messages of a source came.

    On a busy machine the end of a node overtakes them, and dora drops all or the last of these.
    """
    return bool(episode["closed"].get(node, sent) < sent)


def check_saved(cell: Cell, project: Project, stops: int) -> None:
    """The last that was sent is in a file, of each life of the dataflow."""
    saved = episodes(project)
    assert len(saved) == stops
    pairs = zip(ends(cell, "camera"), ends(cell, "arm"), strict=True)
    for episode, (camera, arm) in zip(saved, pairs, strict=True):
        for node, sent in (("camera", camera[1]), ("arm", arm[1])):
            assert episode[node] == sent or is_overtaken(episode, node, sent)
        assert max(camera[0], arm[0]) <= episode["told"]


COUNTING = """
import os, sys
import pyarrow as pa
from dora import Node
node = Node()
for number, event in enumerate(node):
    if event["type"] == "INPUT":
        node.send_output("count", pa.array([number]))
        print(number, flush=True)
        if os.path.exists("fail"):
            sys.exit(3)
"""


def counted(data: bytes) -> list[int]:
    """The numbers that node.py has sent, by a recording."""
    return [one.data[-8] + 256 * one.data[-7] for one in File(data).messages]
