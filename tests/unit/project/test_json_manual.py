"""dora-systemd-json(7) has every key that is printed, and its examples are what is printed."""

import re
from collections.abc import Mapping
from typing import Any

import pytest

from dora_systemd.decisions.advice.evidence import Recorded, Seen
from dora_systemd.decisions.advice.report import AdviceReport
from dora_systemd.decisions.advice.report import report_object as advice_object
from dora_systemd.decisions.advice.rules import Advice
from dora_systemd.decisions.cell.status import NODE_STATES
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.releases.progress import STAGES, checking
from dora_systemd.decisions.views import outcome
from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, STOPPED, UP_WORDS
from dora_systemd.decisions.views.facts import UNKNOWN_STATE, NodeRow
from dora_systemd.decisions.views.findings import Finding, State, finding_values
from dora_systemd.decisions.views.objects import (
    SCHEMA,
    dataflow_object,
    error_object,
    format_json,
)
from dora_systemd.decisions.views.outcome import Outcome, outcome_object
from dora_systemd.decisions.views.releases import step_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.top import Look, TopEntry, look_values
from dora_systemd.decisions.why.last_lines import Word
from dora_systemd.decisions.why.lives import Happening
from dora_systemd.decisions.why.report import Report, Subject, report_object
from dora_systemd.decisions.why.verdict import Restart, Verdict
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import SECOND
from tests.unit.project.test_manpages import sections

PAGE = "dora-systemd-json.7"
READY = 1_767_225_600 * SECOND + 250_000
CRASHED = READY + 90 * SECOND
UUID = "44f30e60-107e-41d2-b6a8-b30cefc153ae"

ROBOT = DataflowRow(
    uuid=UUID,
    name="robot",
    unit="dora-robot.service",
    status="Degraded",
    dataflow="/srv/robot/dataflow.yml",
    text="1/2 nodes running, failed: detector",
    uptime=332 * SECOND,
    started=READY - 2 * SECOND,
    ready=READY,
    nodes_alive=1,
    nodes_total=2,
    cpu_percent=12.5,
    memory=268435456,
    memory_peak=402653184,
    memory_limit=4294967296,
    restarts=1,
    restart_budget={"used": 0, "max": 5, "next_us": None, "resets_us": None},
    nodes=(
        NodeRow(
            *("camera", "running", 4211, 12.5, 134217728, 167772160, 0),
            since=READY,
            text="30 frames/s",
            watchdog=5_000_000,
            sign_age=1_200_000,
            tasks=9,
            tasks_limit=50,
            essential=True,
        ),
        NodeRow(
            *("detector", "failed"),
            restarts=1,
            exit="exit code 1",
            since=CRASHED,
            essential=False,
        ),
    ),
    enabled=True,
)
BROKEN = ROBOT._replace(status="Failed", text="", uptime=None, nodes_alive=0, nodes_total=0)
BROKEN = BROKEN._replace(cpu_percent=None, memory=None, memory_peak=None, nodes=())
REPORT = Report(
    Subject(UUID, "robot", "dora-robot.service", "--system", "/srv/robot/dataflow.yml", True),
    Verdict(
        "Failed",
        Cause.NODE_FAILED,
        "node detector: exit code 1 after 1 restart",
        node="detector",
        at_us=CRASHED,
        began_us=READY,
        details={"exit": "exit code 1", "node_pid": "4217", "event": "node-crashed"},
        starved=("plot",),
        restarts=(Restart(CRASHED - 5 * SECOND, "dora", "detector", "exit code 1"),),
        timeline=(Happening("node-crashed", CRASHED, "detector", "Node detector crashed"),),
        before="stopped",
        before_us=READY - 60 * SECOND,
    ),
    (Word(CRASHED, "detector", "ValueError: the image has 3 channels"),),
)
STOP = Outcome(ROBOT, f"Dataflow stopped: {UUID} (robot)")
NO_DATAFLOW = DoraSystemdError(
    "no dataflow named 'robbot'", "did you mean robot?", ExitCode.NOT_FOUND
)
WHY = {"schema": SCHEMA, **report_object(REPORT, BROKEN)}
CHOSEN = ("schema", "name", "cause", "summary", "node", "at", "details", "before", "remedies")
LOOK = Look(READY, (TopEntry(ROBOT, {"": {"cpu": 1.0}, "camera": {"cpu": 1.5}}),))

EXAMPLES = {
    "doractl list robot -o json": dataflow_object(ROBOT),
    f"doractl why robot -o json | jq '{{{', '.join(CHOSEN)}}}'": {key: WHY[key] for key in CHOSEN},
    "doractl stop robot -o json | jq": outcome_object(STOP, "stop"),
    "doractl stop robbot -o json 2>&1 | jq": {"error": error_object(NO_DATAFLOW)},
}
"""By command, what it prints."""

OBJECTS = {
    "Dataflow": dataflow_object(ROBOT),
    "Node": dataflow_object(ROBOT)["nodes"][0],
    "Why": {
        key: value for key, value in WHY.items() if key not in ("schema", *dataflow_object(ROBOT))
    },
    "Outcome": outcome_object(STOP, "stop"),
    "Error": error_object(NO_DATAFLOW),
    "Progress": step_object(checking()),
}
"""By section, an object whose keys are described there."""


def documented_keys(source: str) -> list[str]:
    items = re.findall(r"^\.It (Va .+)$", source, flags=re.M)
    return [key for item in items for key in re.findall(r"Va (\w+)", item)]


@pytest.mark.parametrize("section", OBJECTS)
def test_every_key_is_described(section: str) -> None:
    assert sorted(documented_keys(sections(PAGE)[section])) == sorted(OBJECTS[section])


def literal_blocks(source: str) -> list[str]:
    found = re.findall(r"^\.Bd -literal.*\n((?:(?!\.Ed).*\n)*)\.Ed$", source, flags=re.M)
    return [block.replace("\\e", "\\") for block in found]


@pytest.mark.parametrize("command", EXAMPLES)
def test_examples_are_what_is_printed(command: str) -> None:
    expected = f"$ {command}\n{format_json(EXAMPLES[command], indent=2)}\n"
    assert expected in literal_blocks(sections(PAGE)["EXAMPLES"])


def test_keys_within_objects_are_named() -> None:
    text = sections(PAGE)
    for section, values in (("Dataflow", [ROBOT.restart_budget]), ("Why", nested(WHY))):
        for one in values:
            assert one
            for key in one:
                assert re.search(rf"\b{key}\b", text[section]), key
    finding = finding_values(Finding("dora", State.OK, "version 1"))
    assert all(f"Va {key}" in text["Others"] for key in ("topic", "state", "text", "remedy"))
    assert list(finding) == ["topic", "state", "text", "remedy"]
    advice = report_of_advice()
    for key in (*advice, *advice["advice"][0]):
        assert re.search(rf"\.Va .*\b{key}\b", text["Others"]), key


def report_of_advice() -> dict[str, Any]:
    seen = (Seen(1, READY, 0),)
    advice = Advice("a", ("memory_limit",), "", "1G", False, "held at most 900M", seen)
    return advice_object(AdviceReport("robot", UUID, Recorded(3, SECOND, {}), [advice]))


def nested(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    lists = (values[key] for key in ("restart_history", "timeline", "last_lines"))
    return [values["before"], *(one for found in lists for one in found)]


def test_words() -> None:
    words = {
        "Dataflow": (*UP_WORDS, FINISHED, STOPPED, FAILED),
        "Node": (*NODE_STATES, UNKNOWN_STATE),
        "Why": (cause for cause in Cause if cause),
        "Outcome": (outcome.DONE, outcome.UNCHANGED, outcome.FAILED),
        "Progress": STAGES,
    }
    for section, those in words.items():
        named = re.findall(r"^\.Li (.+)$", sections(PAGE)[section], flags=re.M)
        assert set(those) <= {word for line in named for word in line.split()}
    assert f"which is {SCHEMA}" in sections(PAGE)["Versions"]


def test_one_dataflow_everywhere() -> None:
    """The same keys and the same types in list, top and why."""
    listed = dataflow_object(ROBOT)
    (top,) = look_values(LOOK, "cpu")["dataflows"]
    assert top.keys() == listed.keys()
    assert {**top, "waits_percent": None, "nodes": None} == {**listed, "nodes": None}
    assert WHY.keys() >= listed.keys()
    again = report_object(REPORT, ROBOT)
    assert {key: again[key] for key in listed} == {**listed, "status": "Failed"}
