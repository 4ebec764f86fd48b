"""Which units are dataflows."""

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.facts.cells import proven, read_cell, read_cells
from dora_systemd.verbs.facts.selector import Selector
from tests.unit.fakes.manager import UUID, FakeManager, options


def test_cells_come_by_name() -> None:
    manager = FakeManager()
    for name in ("robot", "vision", "abcdef00"):
        manager.add(options(name))
    assert [cell.name for cell in read_cells(manager)] == ["abcdef00", "robot", "vision"]


def test_units_that_are_not_ours_are_no_cells() -> None:
    manager = FakeManager()
    command = ["/bin/x", ["/bin/x", "-m", "other"], False]
    manager.add(options("a"), ExecStart=[command])
    manager.add(options("b"), ExecStart=[])
    manager.add(options("c"), LoadState="not-found")
    unit = manager.add(options("d"))
    manager.units["dora-other.service"] = manager.units.pop(unit)
    manager.units["dora-gateway.service"] = manager.units["dora-other.service"]
    assert proven(read_cells(manager)) == []
    for facts in manager.units.values():
        facts["Description"] = ""
    assert read_cells(manager) == []


def test_a_description_saves_a_question() -> None:
    manager = FakeManager()
    for name in ("robot", "vision"):
        manager.add(options(name))
    (robot, _) = read_cells(manager)
    assert (robot.name, robot.uuid, manager.questions) == ("robot", UUID, 1)
    assert robot.dataflow == ""
    assert proven([robot]) == [robot]
    assert (robot.dataflow, robot.options, manager.questions) == (
        "/srv/robot.yml",
        options(),
        2,
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "dora dataflow robot",  # as older versions wrote it
        f"dora dataflow vision ({UUID})",
        f"dora dataflow robot ({UUID.upper()})",
        f"dora dataflow robot ({UUID}) ",
        f"dora dataflow robot ({UUID[:-1]}\n)",
        "My robot",
    ],
)
def test_another_description_is_not_believed(text: str) -> None:
    """--property Description= can be anything: then ExecStart= tells which dataflow it is."""
    manager = FakeManager()
    manager.add(options(), Description=text)
    (robot,) = read_cells(manager)
    assert (robot.uuid, robot.dataflow, manager.questions) == (UUID, "/srv/robot.yml", 2)


def test_nobody_acts_on_a_unit_that_only_has_our_description() -> None:
    manager = FakeManager()
    manager.add(options(), ExecStart=[["/bin/x", ["/bin/x"], False]])
    cells = read_cells(manager)
    assert [cell.name for cell in cells] == ["robot"]
    with pytest.raises(DoraSystemdError, match="no dataflow named 'robot'"):
        Selector("robot").loaded(cells)
    with pytest.raises(DoraSystemdError, match="no dataflow named 'robot'"):
        Selector("robot").find(manager)
    with pytest.raises(DoraSystemdError, match=r"cannot read dora-robot.service: it has ended"):
        _ = cells[0].options


def test_a_unit_that_ends_meanwhile() -> None:
    manager = FakeManager()
    unit = manager.add(options())
    cells = read_cells(manager)
    del manager.units[unit]
    assert proven(cells) == []


def test_one_unit() -> None:
    manager = FakeManager()
    unit = manager.add(options(), active="failed")
    cell = read_cell(manager, unit)
    assert cell is not None
    assert not cell.is_up
    assert read_cell(manager, "dora-other.service") is None
