"""Commands of dora for single nodes, which the runner carries out in dora's place."""

import pytest

from dora_systemd.decisions.dora.node_command import NodeCommand, parse_node_command


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("node restart camera", NodeCommand("restart", "camera")),
        ("node stop camera -d robot", NodeCommand("stop", "camera", "robot")),
        ("node stop --dataflow=robot camera", NodeCommand("stop", "camera", "robot")),
        ("node restart camera --grace 2s", NodeCommand("restart", "camera", "", 2_000_000)),
        ("node restart --grace=1500ms camera", NodeCommand("restart", "camera", "", 1_500_000)),
        ("node restart camera --grace 1h3m", None),
        ("node restart camera --grace", None),
        ("node restart camera plot", None),
        ("node restart", None),
        ("node restart --help", None),
        ("node restart camera --coordinator-port 1", None),
        ("node list", None),
        ("topic list", None),
        ("", None),
    ],
)
def test_what_is_one(line: str, expected: NodeCommand | None) -> None:
    assert parse_node_command(line.split()) == expected


@pytest.mark.parametrize(
    ("what", "told"), [("stop", "Node `a` stopped"), ("restart", "Node `a` restart initiated")]
)
def test_it_is_told_as_by_dora(what: str, told: str) -> None:
    assert NodeCommand(what, "a").told == told
