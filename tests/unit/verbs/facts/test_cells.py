"""Which units are dataflows."""

from dora_systemd.verbs.facts.cells import read_cell, read_cells
from tests.unit.fakes.manager import FakeManager, options


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
    assert read_cells(manager) == []


def test_one_unit() -> None:
    manager = FakeManager()
    unit = manager.add(options(), active="failed")
    cell = read_cell(manager, unit)
    assert cell is not None
    assert not cell.is_up
    assert read_cell(manager, "dora-other.service") is None
