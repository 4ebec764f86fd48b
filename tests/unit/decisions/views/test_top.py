"""The screen of `doractl top`."""

import json

import pytest

from dora_systemd.decisions.resources.containers import Container
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.top import (
    NOTHING,
    Look,
    TopEntry,
    format_summary,
    format_top,
    look_values,
)

SECOND = 1_000_000
NOW = 1_000 * SECOND

ROBOT = TopEntry(
    DataflowRow(
        "44f30e60-107e-41d2-b6a8-b30cefc153ae",
        "robot",
        "dora-robot.service",
        "Degraded",
        uptime=332 * SECOND,
        nodes_alive=2,
        nodes_total=3,
        cpu_percent=112.0,
        cpu_limit=200.0,
        throttled=40.0,
        memory=300 << 20,
        memory_peak=400 << 20,
        memory_limit=1 << 30,
        restarts=2,
        nodes=(
            NodeRow("camera", "running", 7, 12.0, 200 << 20, restarts=0, since=NOW - 5 * SECOND),
            NodeRow("detector", "running", 8, 100.0, 90 << 20, restarts=2, since=NOW - SECOND),
            NodeRow("plot", "failed", exit="exit code 1", since=NOW - SECOND),
        ),
    ),
    {"": {"memory": 12.3, "io": 0.2}, "detector": {"cpu": 30.0}},
)
ARM = TopEntry(
    DataflowRow("u2", "arm", "dora-arm.service", "Starting", cpu_percent=1.0, memory=900 << 20)
)
LOOK = Look(NOW, (ROBOT, ARM))


def test_what_a_node_says_of_itself() -> None:
    (camera, _, plot) = ROBOT.row.nodes
    nodes = (camera._replace(text="12 frames/s"), plot._replace(text="old"))
    shown = format_top(Look(NOW, (TopEntry(ROBOT.row._replace(nodes=nodes)),)), "cpu")
    assert "  camera  Running (12 frames/s)" in shown
    assert "Failed (exit code 1)" in shown


def test_containers_of_a_node_outside_of_its_cgroup() -> None:
    outer = Container("podman", "a" * 64, "outer", "/user.slice/x.scope", 9 << 30)
    inner = outer._replace(name="inner", is_inside=True)
    (camera, *others) = ROBOT.row.nodes

    def shown(*containers: Container, text: str = "") -> str:
        node = camera._replace(containers=containers, text=text)
        row = ROBOT.row._replace(nodes=(node, *others))
        return format_top(Look(NOW, (TopEntry(row),)), "cpu")

    assert "  camera    Running (outside: podman outer 9G)  " in shown(outer, inner)
    assert "Running (12 frames/s; outside: podman outer 9G)" in shown(outer, text="12 frames/s")
    assert "(outside: docker -, podman aaaaaaaaaaaa 9G)" in shown(
        Container("docker"), outer._replace(name="")
    )
    assert "outside" not in shown(inner)


def test_table_by_cpu() -> None:
    assert format_top(LOOK, "cpu").splitlines() == [
        "NAME        STATE                   UPTIME       CPU%      MEM  PEAK  RESTARTS  WAITS FOR",
        "robot       Degraded 2/3          00:05:32  112.0/200  300M/1G  400M         2"
        "  cpu limit 40% memory 12%",
        "  detector  Running               00:00:01      100.0      90M     -         2  cpu 30%",
        "  camera    Running               00:00:05       12.0     200M     -         0",
        "  plot      Failed (exit code 1)         -          -        -     -         -",
        "arm         Starting                     -        1.0     900M     -         -",
    ]


@pytest.mark.parametrize(
    ("width", "titles"),
    [
        (80, "NAME STATE CPU% MEM WAITS FOR"),
        (60, "NAME STATE CPU% MEM"),
        (40, "NAME STATE"),
    ],
)
def test_a_narrow_terminal_has_fewer_columns(width: int, titles: str) -> None:
    lines = format_top(LOOK, "cpu", width).splitlines()
    assert " ".join(lines[0].split()) == titles
    assert max(map(len, lines)) <= width


@pytest.mark.parametrize(
    ("sort", "names"),
    [
        ("cpu", ["robot", "detector", "camera", "plot", "arm"]),
        ("memory", ["arm", "robot", "camera", "detector", "plot"]),
        ("name", ["arm", "robot", "camera", "detector", "plot"]),
    ],
)
def test_order(sort: str, names: list[str]) -> None:
    lines = format_top(LOOK, sort).splitlines()[1:]
    assert [line.split()[0] for line in lines] == names


def test_summary() -> None:
    assert format_summary(LOOK) == "2 dataflows, 2 nodes, CPU 113.0%, memory 1.2G"


def test_nothing_runs() -> None:
    assert format_top(Look(NOW), "cpu") == NOTHING
    assert format_summary(Look(NOW)) == "0 dataflows, 0 nodes, CPU 0.0%, memory 0B"


def test_values_are_json() -> None:
    values = json.loads(json.dumps(look_values(LOOK, "cpu")))
    robot = values["dataflows"][0]
    assert values["at_us"] == NOW
    assert robot["waits_percent"] == {"memory": 12.3, "io": 0.2}
    waits = {one["node"]: one["waits_percent"] for one in robot["nodes"]}
    assert waits == {"camera": None, "detector": {"cpu": 30.0}, "plot": None}
    assert robot["memory_bytes"] == 300 << 20
