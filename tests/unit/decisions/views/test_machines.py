"""What is shown of a dataflow that runs on several machines, and of one machine's part."""

from dora_systemd.decisions.views.dataflows import WAITING, status_word
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.prometheus import format_metrics
from dora_systemd.decisions.views.rows import DataflowRow, NodeRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.decisions.views.top import Look, TopEntry, format_top

NODES = (
    NodeRow("camera", "running", 101, 12.5, 1 << 20, restarts=0),
    NodeRow("yolo", "running", restarts=2, machine="gpu"),
)
ROBOT = DataflowRow(
    *("u", "robot", "dora-robot.service", "Running"), nodes=NODES, machines=("gpu",), restarts=0
)
LINES = format_dataflow(ROBOT).splitlines()


def test_the_nodes_have_their_machine() -> None:
    table = [line.split()[:4] for line in LINES[LINES.index("") + 1 :]]
    assert table == [
        ["NODE", "MACHINE", "STATE", "PID"],
        ["camera", "head", "Running", "101"],
        ["yolo", "gpu", "Running", "-"],
    ]
    assert "Machines: head, gpu" in LINES


def test_one_machine_is_not_mentioned() -> None:
    text = format_dataflow(ROBOT._replace(nodes=NODES[:1], machines=()))
    assert "machine" not in text.lower()


def test_a_part_says_that_it_is_one() -> None:
    text = format_dataflow(ROBOT._replace(machines=(), machine="gpu"))
    assert "Machine:  gpu, the head is another one\n" in text


def test_objects() -> None:
    found = dataflow_object(ROBOT)
    assert (found["machine"], found["machines"]) == (None, ["gpu"])
    assert [node["machine"] for node in found["nodes"]] == ["head", "gpu"]


def test_top_and_metrics() -> None:
    assert "  yolo on gpu " in format_top(Look(0, (TopEntry(ROBOT),)), "name")
    lines = format_metrics([Observed(ROBOT)], "1").splitlines()
    restarts = [line for line in lines if line.startswith("dora_node_restarts_total")]
    assert restarts == [
        'dora_node_restarts_total{dataflow="robot",node="camera"} 0',
        'dora_node_restarts_total{dataflow="robot",node="yolo",machine="gpu"} 2',
    ]


def test_a_dataflow_that_waits_for_a_machine() -> None:
    assert status_word("activating", "start", "gathering") == WAITING
    assert status_word("activating", "auto-restart", "gathering") == "Restarting"
