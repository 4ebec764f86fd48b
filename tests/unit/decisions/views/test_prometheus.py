"""The text for Prometheus, read back with its own parser."""

import re
from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics.parser import (
    text_string_to_metric_families as strict_families,
)
from prometheus_client.parser import text_string_to_metric_families

from dora_systemd.decisions.resources.containers import Container
from dora_systemd.decisions.resources.usage import LineCount, Strain, Usage
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.prometheus import STATES, format_metrics
from dora_systemd.decisions.views.rows import Bundles, DataflowRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.values import INFINITY

SECOND = 1_000_000
ROBOT = Observed(
    DataflowRow(
        "44f30e60-107e-41d2-b6a8-b30cefc153ae",
        "robot",
        "dora-robot.service",
        "Degraded",
        ready=1_700_000_000_500_000,
        nodes_alive=1,
        nodes_total=2,
        nodes=(
            NodeRow(
                *("camera", "running", 7),
                restarts=3,
                since=1_700_000_001_000_000,
                text="12 frames/s",
                watchdog=5 * SECOND,
                sign_age=1_500_000,
            ),
            NodeRow("plot", "failed", exit="exit code 1", restarts=0, since=5),
        ),
    ),
    at_us=9,
    unit_restarts=2,
    usage={
        "": Usage(2_500_000, 4096, 8192, 1 << 30, 1_500_000, (10, 3)),
        "camera": Usage(1_000_000, 1024, None, INFINITY, INFINITY),
    },
    strains={"": Strain({"cpu": (1_500_000, 0), "memory": (20, 10)}, 250_000, 4)},
    lines={"": LineCount(lost=7), "camera": LineCount(1000, 20)},
)
FAILED = Observed(DataflowRow("u", "old", "dora-old.service", "Failed"), unit_restarts=1)


def families(*observed: Observed) -> dict[str, Metric]:
    """The metrics by name; both of Prometheus' parsers read them, the strict one as well."""
    text = format_metrics(observed, "0.1.0")
    assert text.endswith("\n")
    # OpenMetrics, which has the stricter parser, leaves the suffix out of these two lines only.
    openmetrics = re.sub(r"^(# (?:HELP|TYPE) \w+)_total ", r"\1 ", text, flags=re.M)
    families = strict_families(f"{openmetrics}# EOF\n")  # type: ignore[no-untyped-call]
    strict = {family.name: family for family in families}
    found = {family.name: family for family in text_string_to_metric_families(text)}
    assert strict.keys() == found.keys()
    assert all(family.documentation for family in found.values())
    return found


def value(found: Mapping[str, Metric], name: str, **labels: str) -> float:
    family = found[name.removesuffix("_total")]
    values = [one.value for one in family.samples if one.name == name and one.labels == labels]
    assert len(values) == 1, (name, labels, family.samples)
    return float(values[0])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cpu_seconds_total", 2.5),
        ("cpu_limit_cores", 1.5),
        ("cpu_periods_total", 10),
        ("cpu_throttled_periods_total", 3),
        ("cpu_throttled_seconds_total", 0.25),
        ("memory_bytes", 4096),
        ("memory_peak_bytes", 8192),
        ("memory_limit_bytes", 1 << 30),
        ("oom_kills_total", 4),
        ("restarts_total", 2),
        ("ready_time_seconds", 1_700_000_000.5),
        ("nodes", 2),
        ("nodes_alive", 1),
    ],
)
def test_numbers_of_a_dataflow(name: str, expected: float) -> None:
    assert value(families(ROBOT, FAILED), f"dora_dataflow_{name}", dataflow="robot") == expected


def test_numbers_of_nodes() -> None:
    found = families(ROBOT)
    own = {"dataflow": "robot", "node": "camera"}
    assert value(found, "dora_node_cpu_seconds_total", **own) == 1.0
    assert value(found, "dora_node_restarts_total", **own) == 3
    assert value(found, "dora_node_ready_time_seconds", **own) == 1_700_000_001
    assert value(found, "dora_node_log_lines_total", **own) == 1000
    assert value(found, "dora_node_log_lines_suppressed_total", **own) == 20
    assert value(found, "dora_dataflow_log_lines_lost_total", dataflow="robot") == 7
    # No limit is no number; what is not there has no time at which it became ready.
    assert "dora_node_memory_limit_bytes" not in found
    assert "dora_node_memory_peak_bytes" not in found
    assert len(found["dora_node_ready_time_seconds"].samples) == 1


def test_bundles_of_failures() -> None:
    bundles = Bundles(2, "/x/robot.tar", 5, refused=3)
    found = families(replace(ROBOT, row=ROBOT.row._replace(bundles=bundles)), FAILED)
    assert value(found, "dora_dataflow_bundles", dataflow="robot") == 2
    assert value(found, "dora_dataflow_bundles_refused_total", dataflow="robot") == 3
    assert len(found["dora_dataflow_bundles"].samples) == 1


def test_signs_of_life() -> None:
    found = families(ROBOT)
    camera = {"dataflow": "robot", "node": "camera"}
    assert value(found, "dora_node_watchdog_seconds", **camera) == 5
    assert value(found, "dora_node_watchdog_age_seconds", **camera) == 1.5
    assert len(found["dora_node_watchdog_age_seconds"].samples) == 1, "plot has no watchdog"


def test_the_time_left_of_a_stop() -> None:
    camera, plot = ROBOT.row.nodes
    row = ROBOT.row._replace(nodes=(camera._replace(stop_left=SECOND), plot))
    found = families(replace(ROBOT, row=row))
    assert [one.value for one in found["dora_node_stop_left_seconds"].samples] == [1]


def test_containers_outside() -> None:
    outer = Container("podman", "a" * 64, "outer", "/x", 7)
    inner = outer._replace(is_inside=True)
    camera, plot = ROBOT.row.nodes
    nodes = (camera._replace(containers=(outer, inner, Container("docker"))), plot)
    found = families(replace(ROBOT, row=ROBOT.row._replace(nodes=nodes)))
    samples = found["dora_node_outside_memory_bytes"].samples
    labels = [(one.labels["program"], one.labels["container"], one.value) for one in samples]
    assert labels == [("podman", "outer", 7), ("docker", "", 0)]


def test_what_is_special_about_a_node() -> None:
    nodes = (
        NodeRow("camera", "running", essential=True, scheduling="fifo:50", cpus="2-3"),
        NodeRow("plot", "running", essential=False),
    )
    (found,) = families(replace(ROBOT, row=ROBOT.row._replace(nodes=nodes)))[
        "dora_node_info"
    ].samples
    rights = {"essential": "yes", "scheduling": "fifo:50", "cpus": "2-3"}
    expected = {"dataflow": "robot", "node": "camera", **rights}
    assert (found.labels, found.value) == (expected, 1)
    assert "dora_node_info" not in families(ROBOT)


def test_pressure() -> None:
    found = families(ROBOT)
    name = "dora_dataflow_pressure_seconds_total"
    own = {"dataflow": "robot", "resource": "cpu"}
    assert value(found, name, **own, kind="some") == 1.5
    assert value(found, name, **own, kind="full") == 0
    assert len(found[name.removesuffix("_total")].samples) == 4


def test_exactly_one_state() -> None:
    found = families(ROBOT, FAILED)
    states = {
        (one.labels["dataflow"], one.labels["state"]): one.value
        for one in found["dora_dataflow_state"].samples
    }
    assert [key for key, on in states.items() if on] == [("robot", "degraded"), ("old", "failed")]
    assert len(states) == 2 * len(STATES)
    nodes = [one for one in found["dora_node_state"].samples if one.value]
    assert [(one.labels["node"], one.labels["state"]) for one in nodes] == [
        ("camera", "running"),
        ("plot", "failed"),
    ]


def test_kinds() -> None:
    for family in families(ROBOT).values():
        names = {one.name for one in family.samples}
        is_counter = any(name.endswith("_total") for name in names)
        assert family.type == ("counter" if is_counter else "gauge"), family


def test_nothing_runs() -> None:
    assert list(families()) == ["dora_systemd_build_info"]


@given(st.text(max_size=40))
def test_labels_are_escaped(name: str) -> None:
    row = DataflowRow("u", name, "unit", "Running", nodes=(NodeRow(name, "running", restarts=1),))
    text = format_metrics([Observed(row)], "0.1.0")
    found = {family.name: family for family in text_string_to_metric_families(text)}
    (sample,) = found["dora_node_restarts"].samples
    assert sample.labels == {"dataflow": name, "node": name}
