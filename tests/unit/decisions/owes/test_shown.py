"""A silent node in the live table, and wherever the table is shown."""

from dora_systemd.decisions.cell.exits import Exit, ExitKind, parse_exit
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Cell, Do, Record, State
from dora_systemd.decisions.life.table import step
from dora_systemd.decisions.life.view import cell_status, format_status
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.facts import NodeRow, OutputRow
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.prometheus import format_metrics
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.decisions.why.lives import Happening, Life
from dora_systemd.decisions.why.postmortem import examine
from dora_systemd.decisions.why.report import Report, Subject, format_report
from dora_systemd.decisions.why.verdict import Facts
from dora_systemd.values import SECOND

MISSING = "no image for 2s"
RUNNING = NodeStatus("running", 7, policy="on-failure", max_restarts=5)
CELL = Cell(SECOND, 1, {"camera": RUNNING, "sink": RUNNING}, State.RUNNING, ready_us=2)


def silent(then: str) -> life.NodeSilent:
    return life.NodeSilent(9, "camera", "image", MISSING, then, MISSING)


SPEAKS = life.NodeSpeaks(10, "camera", "image", "image again after 3s", "")


def test_a_warning_and_its_end() -> None:
    cell, actions = step(CELL, silent("warn"))
    details = {"output": "image", "reason": MISSING, "then": "warn"}
    assert actions == (Record("node-silent", "camera", details),)
    assert format_status(cell) == f"2/2 nodes running; silent: camera ({MISSING})"
    shown = cell_status(cell, "uuid", (), {}, {})
    assert shown.stage == "degraded"
    assert CellStatus.from_json(shown.to_json()).nodes["camera"].silent == MISSING
    cell, (record,) = step(cell, SPEAKS)
    assert isinstance(record, Record)
    assert record.event == "node-speaks-again"
    assert (format_status(cell), cell_status(cell, "", (), {}, {}).stage) == (
        "2/2 nodes running",
        "running",
    )


def test_a_restart_has_the_silence_as_its_cause() -> None:
    cell, _ = step(CELL, silent("restart"))
    cell, (record,) = step(cell, life.NodeExited(10, "camera", Exit(), will_restart=True))
    assert record == Record("node-ended", "camera", {"exit": f"silent, {MISSING}"})
    camera = cell.nodes["camera"]
    assert (camera.state, camera.silent, camera.is_ended) == ("restarting", "", False)
    assert parse_exit(str(camera.exit)) == Exit(ExitKind.SILENT, words=MISSING)


def test_a_crash_of_a_node_that_is_only_watched_has_its_own_cause() -> None:
    cell, _ = step(CELL, silent("warn"))
    crash = Exit(ExitKind.CODE, 1)
    cell, (record,) = step(cell, life.NodeExited(10, "camera", crash, will_restart=False))
    assert record == Record("node-crashed", "camera", {"exit": "exit code 1"})


def test_the_last_restart_is_the_end_of_the_node() -> None:
    """dora counts it as a success, because the runner has asked for it."""
    spent = {**CELL.nodes, "camera": RUNNING._replace(restarts=5)}
    cell = Cell(SECOND, 1, spent, State.RUNNING, ready_us=2)
    cell, _ = step(cell, silent("restart"))
    cell, _ = step(cell, life.NodeExited(10, "camera", Exit(), will_restart=False))
    assert cell.nodes["camera"].state == "failed"
    cell, _ = step(cell, life.NodeExited(11, "sink", Exit(), will_restart=False))
    cell, _ = step(cell, life.RunFinished(12))
    cell, _ = step(cell, life.ResultKnown(13, {"camera": Exit(), "sink": Exit()}))
    assert cell.failure == f"node camera: silent, {MISSING} after 5 restarts"
    assert cell.exit == RunnerExit.NODES_FAILED


def test_failure_stops_the_nodes_and_then_fails() -> None:
    cell, actions = step(CELL, silent("fail"))
    assert (cell.state, Do.ASK_STOP in actions) == (State.STOPPING, True)
    assert format_status(cell) == f"failed: node camera: {MISSING}"
    for node in ("camera", "sink"):
        cell, actions = step(cell, life.NodeExited(10, node, Exit(), will_restart=False))
        assert actions[0] == Record("node-exited", node)
    assert (cell.state, Do.DISMISS_DAEMON in actions) == (State.LEAVING, True)
    cell, (record, *_) = step(cell, life.ChildExited(11, "daemon", Exit()))
    assert isinstance(record, Record)
    assert (record.event, record.details["cause"]) == ("dataflow-failed", "node-silent")
    assert record.details["nodes"] == "camera"
    assert (cell.state, cell.exit) == (State.ENDED, RunnerExit.FAILED)


def test_a_stop_takes_over_from_a_failure() -> None:
    cell, _ = step(CELL, silent("fail"))
    cell, _ = step(cell, life.StopAsked(10, "SIGTERM"))
    cell, _ = step(cell, life.StopAnswered(11))
    cell, (record, *_) = step(cell, life.ChildExited(12, "daemon", Exit()))
    assert record == Record("dataflow-stopped")
    assert cell.exit == RunnerExit.OK


def test_nobody_is_silent_who_is_not_there() -> None:
    cell = Cell(SECOND, 1, {"sink": RUNNING}, State.RUNNING)
    for event in (silent("warn"), SPEAKS):
        assert step(cell, event) == (cell, ())


OUTPUT = OutputRow("image", 2 * SECOND, "warn", 2_500_000)
CAMERA = NodeRow("camera", "running", 7, silent=MISSING, outputs=(OUTPUT,))
QUIET = OutputRow("boxes", SECOND, "fail")
ROW = DataflowRow(
    *("uuid", "robot", "dora-robot.service", "Degraded"),
    nodes=(CAMERA, NodeRow("detector", "running", 8, outputs=(QUIET,)), NodeRow("sink", "running")),
)


def test_list() -> None:
    lines = format_dataflow(ROW).splitlines()
    assert [line.split()[:2] for line in lines[-3:]] == [
        ["camera", "Silent"],
        ["detector", "Running"],
        ["sink", "Running"],
    ]


def test_json() -> None:
    camera, detector, sink = dataflow_object(ROW)["nodes"]
    assert camera["silent"] == MISSING
    assert camera["outputs"] == [
        {"output": "image", "age_us": 2_500_000, "within_us": 2 * SECOND, "then": "warn"}
    ]
    assert (detector["silent"], detector["outputs"][0]["age_us"]) == (None, None)
    assert (sink["silent"], sink["outputs"]) == (None, [])


def test_metrics() -> None:
    text = format_metrics([Observed(ROW, 0, 0, {}, {}, {})], "1")
    labels = 'dataflow="robot",node="camera"'
    ages = [line for line in text.splitlines() if line.startswith("dora_node_last_output_age")]
    assert ages == [f'dora_node_last_output_age_seconds{{{labels},output="image"}} 2.5']
    told = [line for line in text.splitlines() if line.startswith("dora_node_silent{")]
    assert told == [
        f"dora_node_silent{{{labels}}} 1",
        'dora_node_silent{dataflow="robot",node="detector"} 0',
    ]


SAID = Happening("node-silent", 5 * SECOND, "camera", "Node camera is silent", "i", "b")


def test_why_of_a_node_that_is_silent_now() -> None:
    facts = Facts("Degraded", f"silent: camera ({MISSING})", silent={"camera": MISSING})
    begin = Happening("dataflow-starting", SECOND, invocation="i", boot="b")
    verdict = examine([Life((begin, SAID))], facts)
    assert (verdict.cause, verdict.node, verdict.at_us) == (
        Cause.NODE_SILENT,
        "camera",
        5 * SECOND,
    )
    assert verdict.is_failure
    text = format_report(Report(Subject("u", "robot", "dora-robot.service", "--system"), verdict))
    assert f"Why:      node camera: {MISSING}" in text
    assert "find out why camera sends nothing" in text
    assert "stays down" not in text


def test_why_of_one_that_has_ended_for_it() -> None:
    crash = Happening("node-ended", 6 * SECOND, "camera", "", "i", "b",
                      {"exit": f"silent, {MISSING}"})  # fmt: skip
    facts = Facts("Degraded", failed={"camera": f"silent, {MISSING} after 5 restarts"})
    verdict = examine([Life((SAID, crash))], facts)
    assert (verdict.cause, verdict.is_away) == (Cause.NODE_SILENT, True)
    assert verdict.summary == f"node camera: silent, {MISSING} after 5 restarts"


def test_why_of_a_dataflow_that_has_failed_for_it() -> None:
    details = {"reason": f"node camera: {MISSING}", "cause": "node-silent", "nodes": "camera"}
    end = Happening("dataflow-failed", 7 * SECOND, "", "", "i", "b", details)
    verdict = examine([Life((SAID, end))], Facts("Failed"))
    assert (verdict.cause, verdict.node) == (Cause.NODE_SILENT, "camera")
    assert verdict.summary == f"node camera: {MISSING}"
