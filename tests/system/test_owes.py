"""Outputs that nodes owe: silence is found, acted on and told, with real dora and systemd."""

import json
import os
import signal
from typing import Any

import pytest

from tests.system.cells import Cell, Project, run, wait_for

CAMERA = """
import os, time
from dora import Node
import pyarrow as pa
node = Node()
for event in node:
    if event["type"] == "INPUT" and not os.path.exists("quiet"):
        node.send_output("image", pa.array([1]))
"""
STUBBORN = """
import os, time
from dora import Node
import pyarrow as pa
node = Node()
while not os.path.exists("quiet"):
    node.send_output("image", pa.array([1]))
    time.sleep(0.02)
time.sleep(1000)
"""
SINK = """
from dora import Node
for event in Node():
    if event["type"] == "INPUT":
        print("seen", flush=True)
"""
FLOW = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}, outputs: [image]}
  - id: sink
    path: sink.py
    inputs: {image: {source: camera/image, queue_size: 1000}, tick: dora/timer/secs/1}
"""
ALONE = """
nodes:
  - {id: camera, path: camera.py, inputs: {tick: dora/timer/millis/20}, outputs: [image]}
  - {id: sink, path: sink.py, inputs: {tick: dora/timer/secs/1}}
"""
SILENT = ("is silent", "was ended: silent", "restarted", "after failure")
KILLED = ("node exited with error",)


def flow(project: Project, owes: str, camera: str = CAMERA) -> Any:
    project.write("camera.py", camera)
    project.write("sink.py", SINK)
    project.write("flow.systemd.yml", f"nodes: {{camera: {{owes: {owes}}}}}")
    return project.write("flow.yml", FLOW)


def camera_of(cell: Cell) -> dict[str, Any]:
    row = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    node: dict[str, Any] = next(one for one in row["nodes"] if one["node"] == "camera")
    return node


def has(cell: Cell, event: str, count: int = 1) -> bool:
    return [name for name, _ in cell.events()].count(event) >= count


@pytest.mark.warns(*SILENT)
def test_a_silent_node_is_restarted(cell: Cell, project: Project) -> None:
    """Within dora's own budget, though the dataflow has no policy; the others run on."""
    cell.start(flow(project, "{output: image, within: 1s, first: 20s}"))
    wait_for("the camera is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    sink = cell.status.nodes["sink"].pid
    quiet = project.write("quiet", "")
    wait_for("it is silent", lambda: has(cell, "node-silent"))
    quiet.unlink()
    wait_for("it speaks again", lambda: has(cell, "node-speaks-again"))
    camera = camera_of(cell)
    assert (camera["restarts"], camera["max_restarts"], camera["silent"]) == (1, 5, None)
    assert cell.status.nodes["sink"].pid == sink
    assert ("node-ended", "camera") in cell.events()
    assert not has(cell, "node-crashed")
    words = cell.doractl("why", cell.name, check=False).stdout
    assert "camera 1 (silent, no image for 1s)" in words
    assert "dora-systemd-probe" not in words + cell.doractl("list", cell.name).stdout
    assert not cell.messages("dora-systemd-probe")


@pytest.mark.warns(*SILENT, *KILLED)
def test_a_spent_budget_is_the_end_of_the_node(cell: Cell, project: Project) -> None:
    """A node that does not respond is killed, long before its grace, and counted by dora."""
    path = flow(project, "{output: image, within: 1s, first: 1s}", STUBBORN)
    cell.start(path, "--max-restarts", "1", "--grace-duration", "10min")
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    project.write("quiet", "")
    wait_for("its restart is used up", lambda: cell.status.nodes["camera"].state == "failed", 40)
    status = cell.doractl("list", cell.name).stdout
    assert "Degraded (1/2 nodes running; failed: camera (silent, no image within 1s" in status
    words = cell.doractl("why", cell.name, check=False).stdout
    assert "node camera: silent, no image within 1s of its start after 1 restart" in words


@pytest.mark.warns("is silent")
def test_warn_only_tells(cell: Cell, project: Project) -> None:
    cell.start(flow(project, "{output: image, within: 500ms, then: warn}"))
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    quiet = project.write("quiet", "")
    wait_for("it is silent", lambda: camera_of(cell)["silent"] == "no image for 500ms")
    assert camera_of(cell)["outputs"][0]["age_us"] >= 500_000
    assert "silent: camera (no image for 500ms)" in cell.show("StatusText")
    shown = cell.doractl("list", cell.name).stdout
    assert ("Silent" in shown, "Degraded" in shown) == (True, True)
    words = cell.doractl("why", cell.name, check=False).stdout
    assert "Why:      node camera: no image for 500ms" in words
    quiet.unlink()
    wait_for("it speaks again", lambda: has(cell, "node-speaks-again"))
    assert (camera_of(cell)["silent"], camera_of(cell)["restarts"]) == (None, 0)
    assert "camera" not in cell.show("StatusText")


TICK = CAMERA.replace("image", "t")
FED = """
nodes:
  - {id: tick, path: tick.py, inputs: {tick: dora/timer/millis/20}, outputs: [t]}
  - {id: camera, path: camera.py, inputs: {tick: tick/t}, outputs: [image]}
"""


@pytest.mark.warns("is silent")
def test_a_starved_node_is_not_restarted(cell: Cell, project: Project) -> None:
    """The node that it gets nothing from is named, and nobody's restarts are used up."""
    project.write("tick.py", TICK)
    path = flow(project, "{output: image, within: 1s}")
    path.write_text(FED)
    cell.start(path)
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    (tick,) = cell.pids("node-tick")
    os.kill(tick, signal.SIGSTOP)
    words = "no image for 1s, starved of tick/t"
    wait_for("it is starved", lambda: camera_of(cell)["silent"] == words)
    why = cell.doractl("why", cell.name, check=False).stdout
    assert f"node tick: sends nothing; camera: {words}" in why
    os.kill(tick, signal.SIGCONT)
    wait_for("it speaks again", lambda: has(cell, "node-speaks-again"))
    assert (camera_of(cell)["silent"], camera_of(cell)["restarts"]) == (None, 0)


@pytest.mark.warns("is silent", "failed: node camera", "Failed with result", "status=1")
def test_fail_ends_the_dataflow_by_its_policy(cell: Cell, project: Project) -> None:
    path = flow(project, "{output: image, within: 500ms, then: fail}")
    cell.start(path, "--restart-policy", "on-failure", "--max-restarts", "2")
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    quiet = project.write("quiet", "")
    wait_for("it failed", lambda: has(cell, "dataflow-failed"))
    quiet.unlink()
    wait_for("it is back", lambda: has(cell, "dataflow-started", 2))
    failed = cell.journal("DORA_EVENT=dataflow-failed")[0]
    assert (failed["DORA_CAUSE"], failed["DORA_NODES"]) == ("node-silent", "camera")
    assert has(cell, "node-exited", 2)  # they were asked, and had time to exit


@pytest.mark.warns(*KILLED)
def test_a_stopped_cell_is_no_silence(cell: Cell, project: Project) -> None:
    """A cell that is stopped for longer than `within`, and a probe that is killed."""
    cell.start(flow(project, "{output: image, within: 1s, then: warn}"))
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    before = cell.pids("node-dora-systemd-probe")
    run("systemctl", cell.scope.flag, "freeze", cell.unit)
    wait_for("it is too late", lambda: camera_of(cell)["outputs"][0]["age_us"] > 3_000_000)
    run("systemctl", cell.scope.flag, "thaw", cell.unit)
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] < 500_000)
    for pid in before:
        os.kill(pid, signal.SIGKILL)
    wait_for(
        "another probe listens",
        lambda: (after := cell.pids("node-dora-systemd-probe")) and after != before
        and camera_of(cell)["outputs"][0]["age_us"] < 500_000,
    )  # fmt: skip
    assert not has(cell, "node-silent")


def test_the_probe_keeps_no_dataflow(cell: Cell, project: Project) -> None:
    """The dataflow finishes with its own nodes."""
    over = 'if os.path.exists("over"):\n        break\n    if event'
    camera = CAMERA.replace("if event", over)
    path = flow(project, "{output: image, within: 5s}", camera)
    path.write_text(path.read_text().replace(", tick: dora/timer/secs/1", ""))
    cell.start(path)
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    assert "2/2 nodes running" in cell.show("StatusText")
    project.write("over", "")
    wait_for("it has finished", lambda: cell.is_gone)
    assert (cell.show("Result"), has(cell, "dataflow-finished")) == ("success", True)


def test_hot_reload_leaves_it_watched(cell: Cell, project: Project) -> None:
    """A node that gets other inputs is removed and added in dora, and so loses who read from it."""
    path = flow(project, "{output: image, within: 3s}")
    path.write_text(ALONE)
    cell.start(path)
    wait_for("it is heard", lambda: camera_of(cell)["outputs"][0]["age_us"] is not None)
    (probe,), run_id = cell.pids("node-dora-systemd-probe"), cell.status.run
    path.write_text(ALONE.replace("millis/20", "millis/10"))
    assert "camera was reconnected" in cell.doractl("reload", cell.name).stdout
    wait_for(
        "another probe listens",
        lambda: (
            cell.pids("node-dora-systemd-probe") not in ([], [probe])
            and camera_of(cell)["outputs"][0]["age_us"] < 500_000
        ),
    )
    assert cell.status.run == run_id
    assert not has(cell, "node-silent")


@pytest.mark.warns("Failed with result", "status=78", "failed: cannot watch", "exited", "start")
def test_an_output_that_no_node_has(cell: Cell, project: Project) -> None:
    done = cell.start(flow(project, "{output: imag, within: 3s}"), check=False)
    words = "cannot watch 'imag' of the node 'camera': no such output"
    assert words in done.stderr
    assert "did you mean image?" in done.stderr
    assert cell.is_gone
    done = cell.start(flow(project, "{output: image, within: 3}"), check=False)
    assert "within is '3' (nodes.camera.owes in " in done.stderr
