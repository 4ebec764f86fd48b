"""The recorder with real dora and systemd: what its ring has after everything has died."""

import io
import json
import os
import signal
import tarfile
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.recorder.mcap import write_recording
from dora_systemd.decisions.recorder.reading import Reading, Recorded
from dora_systemd.trust.rings import find_ring
from tests.lab.pace import bound, pace
from tests.system.cells import Cell, Project, wait_for
from tests.unit.fakes.recorder.mcap import File

CAMERA = """
import os, time
from dora import Node
import pyarrow as pa
node = Node()
at = 0
for event in node:
    if event["type"] == "INPUT":
        at += 1
        node.send_output("image", pa.array([at] * 50_000, type=pa.int64()), {"width": 5})
        node.send_output("count", pa.array([at]))
        print(at, flush=True)
"""
FLOW = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}, outputs: [image, count]}
"""


LARGE = "dora-rs/dora#2742"
"""A diagnosis of dora about each output with large messages."""


class Ring:
    """The ring that systemd keeps, of the dataflow that was started last."""

    uuid, uid = "", 0

    def __init__(self) -> None:
        self.file = find_ring([1], self.uuid, self.uid)

    def __bool__(self) -> bool:
        return self.file is not None

    def __del__(self) -> None:
        if self.file is not None:
            self.file.close()

    def reading(self) -> Reading:
        assert self.file is not None
        return Reading(self.file, self.file.size, 1 << 30)

    def messages(self) -> list[Recorded]:
        return list(self.reading().messages()) if self else []

    def last(self) -> int:
        """The number of the last message."""
        found = self.messages()
        return found[-1].head.number if found else 0

    @property
    def used(self) -> int:
        assert self.file is not None
        return self.file.used


def has_more(last: int) -> bool:
    return Ring().last() > last


def start(cell: Cell, path: Path, *words: str) -> None:
    cell.start(path, *words)
    Ring.uuid, Ring.uid = cell.status.uuid, cell.paths.root.stat().st_uid


def flow(project: Project, record: Any) -> Path:
    project.write("camera.py", CAMERA)
    project.write("flow.systemd.yml", json.dumps({"record": record}))
    return project.write("flow.yml", FLOW)


def file_of(ring: Ring) -> File:
    """The file of the ring, which is read strictly."""
    out = io.BytesIO()
    write_recording(ring.reading(), out.write, {})
    return File(out.getvalue())


@pytest.mark.warns(LARGE)
def test_by_default_the_last_message_of_all_outputs_and_more_of_small_ones(
    cell: Cell, project: Project
) -> None:
    start(cell, flow(project, True))
    wait_for("messages are recorded", lambda: len(Ring().messages()) > 100)
    ring = Ring()
    file = file_of(ring)
    counts = [one.topic for one in file.messages]
    assert (counts.count("camera/image"), counts.count("camera/image#metadata")) == (1, 1)
    assert counts.count("camera/count") > 90
    assert next(one for one in file.messages if one.encoding == "json").data == b'{"width": 5}'
    assert dict(file.metadata)["dora-systemd"]["dataflow"] == cell.name
    assert ring.used < 1024 * 1024
    assert "dora-systemd-recorder" not in cell.doractl("list", cell.name).stdout
    cell.doractl("stop", cell.name)
    assert not Ring(), "its memory is free"


@pytest.mark.warns(LARGE)
def test_named_outputs_in_their_memory(cell: Cell, project: Project) -> None:
    start(cell, flow(project, {"memory": "4M", "outputs": ["camera/image"]}))
    wait_for("it is full", lambda: Ring() and Ring().reading().states[0].evicted > 20)
    assert list(Ring().reading().header.outputs) == ["camera/image"]
    assert 8 <= len(file_of(Ring()).messages) // 2 <= 10
    assert Ring().used <= 4.2 * 1024 * 1024


def test_what_cannot_be_recorded(cell: Cell, project: Project) -> None:
    path = flow(project, {"outputs": ["camera/imge"]})
    for flags, words in (
        ((), "cannot record 'camera/imge': no such output"),
        (("--record", "memory=100T"), "cannot record in 100T and 160M for the recorder: "),
        (("--record", "memory=5"), "cannot read what to record: memory is '5'"),
        (("--record", "lst=5s"), "cannot read what to record: unknown key 'lst'"),
    ):
        done = cell.doractl("start", str(path), *flags, check=False)
        assert words in done.stderr
        assert done.returncode in (2, 5), done.stderr


@pytest.mark.warns(LARGE)
def test_it_is_changed_while_it_runs(cell: Cell, project: Project) -> None:
    start(cell, flow(project, {"memory": "8M", "outputs": ["camera/image"]}))
    wait_for("it records", partial(has_more, 20))
    refused = cell.doractl("set", cell.name, "--record", "outputs=camera/imge", check=False)
    assert "cannot record 'camera/imge': no such output" in refused.stderr
    assert Ring().last() > 20
    done = cell.doractl("set", cell.name, "--record", "off").stdout
    assert done.startswith("Recorder changed: ")
    wait_for("its memory is free", lambda: not Ring())
    wait_for("it is gone", lambda: not cell.pids("node-dora-systemd-recorder"))
    cell.doractl("restart", cell.name)
    assert not Ring()
    cell.doractl("set", cell.name, "--record", "memory=4M")
    wait_for("it records again", partial(has_more, 20))
    assert len(Ring().reading().header.outputs) == 2
    cell.doractl("restart", cell.name)
    wait_for("it goes on", partial(has_more, 20))
    assert Ring().reading().header.budget == 4 * 1024 * 1024


def freeze(cell: Cell) -> None:
    """Stop the process of the recorder: it ends within no grace, as on a machine that is busy."""
    for pid in cell.pids("node-dora-systemd-recorder"):
        os.kill(pid, signal.SIGSTOP)


@pytest.mark.warns(LARGE, "killed on drop")
def test_one_that_ends_too_late_is_no_failure(cell: Cell, project: Project) -> None:
    path = flow(project, {"memory": "8M", "outputs": ["camera/image"]})
    start(cell, path, "--grace-duration", f"{round(2 * max(pace(), 1))}s")
    wait_for("it records", partial(has_more, 5))
    freeze(cell)
    cell.doractl("set", cell.name, "--record", "off")
    wait_for("it is gone", lambda: not cell.pids("node-dora-systemd-recorder"))
    cell.doractl("set", cell.name, "--record", "memory=4M")
    wait_for("it records again", partial(has_more, 5))
    freeze(cell)
    cell.doractl("stop", cell.name)
    assert cell.doractl("why", cell.name).stdout.startswith(f"{cell.name}: Stopped\n")


FAST = """
import os, time
from dora import Node
import pyarrow as pa
node = Node()
data = pa.array(memoryview(os.urandom(1_000_000)), type=pa.uint8())
due = time.monotonic()
while node.try_recv() is None:
    node.send_output("image", data)
    due += 0.005  # 200 MB a second
    time.sleep(max(0, due - time.monotonic()))
"""
STUCK = """
import os, signal
from dora import Node
node = Node()
node.next()
os.kill(os.getpid(), signal.SIGSTOP)
"""
FAST_FLOW = """
nodes:
  - {id: camera, path: camera.py, outputs: [image]}
  - {id: sink, path: sink.py, inputs: {image: camera/image}}
"""
MESSAGES = int(os.environ.get("MESSAGES", "200"))
"""An hour has 720,000 of them: `tests/lab/lab run --env MESSAGES=720000 -- pytest ...`."""


@pytest.mark.timeout(bound(300) + MESSAGES / 10)
@pytest.mark.warns(
    LARGE, "Discarding", "grace", "exited with error", "sink", "NextEvent", "on drop"
)
def test_memory_is_bounded_though_a_consumer_is_stopped(cell: Cell, project: Project) -> None:
    project.write("camera.py", FAST)
    project.write("sink.py", STUCK)
    path = project.write("flow.yml", FAST_FLOW)
    start(cell, path, "--record", "memory=8M,outputs=camera/image", "--grace-duration", "1s")
    seen: set[int] = set()

    def is_done() -> bool:
        ring = Ring()
        assert not ring or ring.used <= 8.2 * 1024 * 1024
        seen.update(cell.pids("node-dora-systemd-recorder"))
        if not ring:
            return False
        # On a busy machine the recorder, which has the lowest priority, receives few of them.
        state = ring.reading().states[0]
        return state.received > 10 and state.received + state.dropped > MESSAGES

    wait_for("many messages were sent", is_done, 60 + MESSAGES / 10)
    (recorder,) = seen  # nothing has killed it, and no limit of its memory
    os.kill(recorder, signal.SIGSTOP)  # else it overwrites what a slow reader has not read yet
    try:
        assert 5 <= len(file_of(Ring()).messages) <= 8
    finally:
        os.kill(recorder, signal.SIGCONT)


PICTURES = """
import time
from dora import Node
import pyarrow as pa
node = Node()
for event in node:
    if event["type"] == "INPUT":
        metadata = {"encoding": "rgb8", "width": 4, "height": 2}
        node.send_output("image", pa.array(range(24), type=pa.uint8()), metadata)
"""
PICTURES_FLOW = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}, outputs: [image]}
"""


def test_a_bundle_has_the_messages_and_pictures(cell: Cell, project: Project) -> None:
    project.write("camera.py", PICTURES)
    start(cell, project.write("flow.yml", PICTURES_FLOW), "--record", "yes")
    wait_for("it records", partial(has_more, 20))
    bundle = project.root / "robot.tar"
    cell.doractl("bundle", cell.name, "-o", str(bundle), "--images")
    with tarfile.open(bundle) as archive:
        names = archive.getnames()
        (recording,) = (one for one in names if one.endswith("recording.mcap"))
        found = archive.extractfile(recording)
        assert found is not None
        file = File(found.read())
    assert len(file.messages) > 40
    assert file.messages[0].topic == "camera/image"
    assert sum("images/camera-image/" in one and one.endswith(".png") for one in names) == 10
    assert "requested by" in cell.doractl("why", "--bundle", str(bundle)).stdout
    cell.doractl("bundle", cell.name, "-o", str(bundle), "--no-journal")
    with tarfile.open(bundle) as archive:
        assert not [one for one in archive.getnames() if "recording" in one]
