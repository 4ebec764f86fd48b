"""What a member tells of its nodes' CPU and memory, and what the head believes of it."""

import json
from typing import Any

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.machines.usage import NodeUse, merged, parse_use, told_use, uses_of
from dora_systemd.decisions.resources.usage import CpuSample, Usage
from dora_systemd.values import INFINITY, SECOND

USE = Usage(3 * SECOND, 1 << 20, 2 << 20, INFINITY, SECOND // 2, (40, 10))
BEFORE = CpuSample(0, {"mid": 2 * SECOND}, {"mid": (20, 5)})
NOW = CpuSample(4 * SECOND, {"mid": 3 * SECOND}, {"mid": (40, 10)})
TOLD = told_use(USE, (BEFORE,), NOW, "mid")
NODES = {
    "eye": NodeStatus("running", 7),
    "mid": NodeStatus("running", machine="gpu"),
}


def there_and_back(raw: Any) -> NodeUse | None:
    return parse_use(json.loads(json.dumps(raw)))


def test_what_is_told_is_what_is_shown() -> None:
    found = there_and_back(TOLD)
    assert found == NodeUse(USE._replace(memory_max=None), 25.0, 25.0)
    assert found
    assert found.facts() == {
        "cpu_percent": 25.0,
        "cpu_limit": 50.0,
        "throttled": 25.0,
        "memory": 1 << 20,
        "memory_peak": 2 << 20,
        "memory_limit": None,
    }


def test_a_machine_without_controllers() -> None:
    found = there_and_back(told_use(Usage(SECOND), (), NOW, "mid"))
    assert found
    assert (found.facts()["memory"], found.facts()["throttled"]) == (None, None)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, -1.0),
        (0, 1e9),
        (0, 1),
        (0, "12.5"),
        (1, 100.5),
        (2, -1),
        (2, 2**63),
        (2, True),
        (2, None),
        (3, 0.5),
        (5, -1),
        (5, 2**64),
        (5, "1M"),
        (8, []),
    ],
)
def test_numbers_that_cannot_be(place: int, value: object) -> None:
    told = list(TOLD)
    told[place] = value
    assert there_and_back(told) is None


@pytest.mark.parametrize("raw", [[], TOLD[:-1], [*TOLD, 1], "mid", None, 1, {"cpu": 1}])
def test_other_forms(raw: object) -> None:
    assert there_and_back(raw) is None


def test_a_member_is_believed_for_its_own_nodes_only() -> None:
    said = CellStatus(usage={"eye": TOLD, "mid": TOLD, "nose": TOLD})
    flood = CellStatus(usage={"mid": ["x" * 100_000]})
    assert merged(CellStatus(nodes=NODES), {"gpu": flood}).usage == {}
    table = merged(CellStatus(nodes=NODES), {"gpu": said})
    assert set(table.usage) == {"mid"}
    again = CellStatus.from_json(table.to_json())
    assert set(uses_of(again)) == {"mid"}
    assert merged(CellStatus(nodes=NODES), {}).usage == {}


def test_what_a_node_says_of_itself() -> None:
    """Not when: each machine has a clock of its own."""
    said = CellStatus(signs={"mid": ("warm", 17, SECOND), "eye": ("cold", 17, 0)})
    table = merged(CellStatus(nodes=NODES), {"gpu": said})
    assert table.signs == {"mid": ("warm", 0, 0)}
    strange = CellStatus(signs={"mid": ("x" * 100_000, "y")})
    assert merged(CellStatus(nodes=NODES), {"gpu": strange}).signs == {"mid": ("", 0, 0)}


def test_the_time_left_of_nodes_elsewhere() -> None:
    said = CellStatus(stop_dues={"mid": 7, "eye": 8})
    table = merged(CellStatus(nodes=NODES, stop_dues={"eye": 5}), {"gpu": said})
    assert table.stop_dues == {"eye": 5, "mid": 7}


def test_a_head_does_not_lie_about_its_own_nodes_either() -> None:
    assert uses_of(CellStatus(nodes=NODES, usage={"eye": TOLD, "nose": TOLD})) == {}
