"""The objects of `-o json`: what is unknown, points in time, versions."""

import json

import pytest

from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.objects import dataflow_object, format_json, moment
from dora_systemd.decisions.views.outcome import Outcome, Thing, outcome_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.values import SECOND

UNKNOWN = DataflowRow("u", "robot", "dora-robot.service", "Failed", nodes=(NodeRow("a", "failed"),))
KNOWN_OF_IT = {"name", "uuid", "unit", "status", "enabled", "machines", "nodes", "inhibitors"}
KNOWN_OF_NODE = {"node", "state", "outputs", "containers"}


def test_what_is_unknown_is_null() -> None:
    values = dataflow_object(UNKNOWN)
    assert {key for key, value in values.items() if value is not None} == KNOWN_OF_IT
    (node,) = values["nodes"]
    assert {key for key, value in node.items() if value is not None} == KNOWN_OF_NODE


def test_zero_is_not_unknown() -> None:
    row = UNKNOWN._replace(cpu_percent=0.0, memory=0, restarts=0, nodes_total=1, uptime=0)
    values = dataflow_object(row)
    keys = ("cpu_percent", "memory_bytes", "restarts", "nodes_alive", "uptime_us")
    assert [values[key] for key in keys] == [0] * len(keys)
    assert dataflow_object(row._replace(problem="broken"))["nodes_alive"] is None


def test_each_value_of_a_node_is_under_its_key() -> None:
    row = NodeRow("a", "running", pid=7, exit="exit code 1", text="hot", machine="gpu")
    row = row._replace(needs="/dev/x", watchdog=5, sign_age=3, max_restarts=2, essential=True)
    row = row._replace(scheduling="fifo:5", cpus="2-3", silent="no image for 2s", stop_left=9)
    (node,) = dataflow_object(UNKNOWN._replace(nodes=(row,)))["nodes"]
    assert {key: node[key] for key in node if node[key] is not None} == {
        **{"node": "a", "state": "running", "machine": "gpu", "pid": 7, "exit": "exit code 1"},
        **{"waits_for": "/dev/x", "text": "hot", "watchdog_us": 5, "watchdog_age_us": 3},
        **{"max_restarts": 2, "essential": True, "scheduling": "fifo:5", "cpus": "2-3"},
        **{"silent": "no image for 2s", "outputs": [], "stop_left_us": 9},
        "containers": [],
    }


@pytest.mark.parametrize(
    ("at_us", "text"),
    [
        (1, "1970-01-01T00:00:00.000001Z"),
        (1_767_225_600 * SECOND, "2026-01-01T00:00:00.000000Z"),
        (0, None),
    ],
)
def test_a_point_in_time_has_two_forms(at_us: int, text: str | None) -> None:
    assert moment("at", at_us) == {"at": text, "at_us": at_us or None}


def test_the_outermost_objects_have_the_version() -> None:
    assert format_json({"a": {"b": 1}}) == '{"schema": 1, "a": {"b": 1}}'
    assert json.loads(format_json([{"a": 1}, {"a": 2}], indent=2)) == [
        {"schema": 1, "a": 1},
        {"schema": 1, "a": 2},
    ]


def test_an_outcome_without_a_dataflow() -> None:
    done = Outcome(Thing(), "Installed: /x\nand more", details={"path": "/x"})
    values = outcome_object(done, "setup")
    assert (values["name"], values["uuid"], values["unit"], values["node"]) == (None,) * 4
    assert (values["text"], values["details"]) == ("Installed: /x", {"path": "/x"})
