"""What is shown of a dataflow that runs on several machines, and of one machine's part."""

from dora_systemd.decisions.resources.usage import Strain, Usage
from dora_systemd.decisions.views.dataflows import WAITING, status_word
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.prometheus import format_metrics
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed, observed_values
from dora_systemd.decisions.views.top import Look, TopEntry, format_top
from dora_systemd.values import SECOND

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


USES = {"": Usage(9 * SECOND), "camera": Usage(SECOND), "yolo": Usage(2 * SECOND, 1 << 20)}
OBSERVED = Observed(ROBOT, 17, usage=USES, strains={"": Strain(), "camera": Strain()})


def test_metrics_of_a_node_elsewhere() -> None:
    """Its counters, as far as the other machine has sent any."""
    lines = format_metrics([OBSERVED], "1").splitlines()
    own = [line for line in lines if 'machine="gpu"' in line and "_state{" not in line]
    labels = '{dataflow="robot",node="yolo",machine="gpu"}'
    assert own == [
        f"dora_node_restarts_total{labels} 2",
        f"dora_node_cpu_seconds_total{labels} 2.0",
        f"dora_node_cpu_periods_total{labels} 0",
        f"dora_node_cpu_throttled_periods_total{labels} 0",
        f"dora_node_memory_bytes{labels} {1 << 20}",
    ]


def test_the_page_makes_no_share_of_what_comes_now_and_then() -> None:
    groups = observed_values(OBSERVED)["groups"]
    assert (groups["camera"]["cpu_us"], groups["yolo"]["cpu_us"]) == (SECOND, None)


def test_a_dataflow_that_waits_for_a_machine() -> None:
    assert status_word("activating", "start", "gathering") == WAITING
    assert status_word("activating", "auto-restart", "gathering") == "Restarting"
