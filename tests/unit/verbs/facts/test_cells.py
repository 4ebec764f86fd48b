"""Which units are dataflows, and which of them a selector means."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.facts.cells import Cell, read_cell, read_cells, select_cell
from tests.unit.fakes.manager import UUID, FakeManager, options

OTHER = "550e8400-0000-41d4-a716-446655440000"
THIRD = "abcdef00-0000-41d4-a716-446655440000"


@pytest.fixture
def cells() -> list[Cell]:
    manager = FakeManager()
    for name, uuid in (("robot", UUID), ("vision", OTHER), ("abcdef00", THIRD)):
        manager.add(options(name, uuid))
    return read_cells(manager)


def test_cells_come_by_name(cells: list[Cell]) -> None:
    assert [cell.name for cell in cells] == ["abcdef00", "robot", "vision"]


def test_units_that_are_not_ours_are_no_cells() -> None:
    manager = FakeManager()
    command = ["/bin/x", ["/bin/x", "-m", "other"], False]
    manager.add(options("a"), ExecStart=[command])
    manager.add(options("b"), ExecStart=[])
    manager.add(options("c"), LoadState="not-found")
    unit = manager.add(options("d"))
    manager.units["dora-other.service"] = manager.units.pop(unit)
    manager.units["dora-gateway.service"] = manager.units["dora-other.service"]
    assert read_cells(manager) == []


@pytest.mark.parametrize(
    "selector", ["robot", "dora-robot.service", UUID, UUID.upper(), UUID[:12], "550E8400-E"]
)
def test_selectors(cells: list[Cell], selector: str) -> None:
    assert select_cell(cells, selector).name == "robot"


def test_a_name_wins_over_a_prefix(cells: list[Cell]) -> None:
    assert select_cell(cells, "abcdef00").uuid == THIRD


def test_an_ambiguous_prefix_lists_what_it_fits(cells: list[Cell]) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        select_cell(cells, "550e8400")
    assert caught.value.code is ExitCode.USAGE
    assert f"{UUID} (robot)" in caught.value.hint
    assert f"{OTHER} (vision)" in caught.value.hint


@pytest.mark.parametrize(
    ("selector", "hint"),
    [
        ("robto", "did you mean robot?"),
        ("zzzz", "known dataflows: abcdef00, robot, vision"),
        ("550", "known dataflows: abcdef00, robot, vision"),
    ],
)
def test_nothing_fits(cells: list[Cell], selector: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        select_cell(cells, selector)
    assert caught.value.code is ExitCode.NOT_FOUND
    assert caught.value.hint == hint


@given(st.text())
def test_any_selector_is_answered(selector: str) -> None:
    manager = FakeManager()
    manager.add(options())
    try:
        assert select_cell(read_cells(manager), selector).name == "robot"
    except DoraSystemdError as error:
        assert error.message.startswith(("cannot", "no dataflow named"))


def test_one_unit() -> None:
    manager = FakeManager()
    unit = manager.add(options(), active="failed")
    cell = read_cell(manager, unit)
    assert cell is not None
    assert not cell.is_up
    assert read_cell(manager, "dora-other.service") is None
