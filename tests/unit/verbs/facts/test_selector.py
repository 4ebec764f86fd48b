"""Which dataflow a text means, wherever it is looked for."""

from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.bus.manager import UnitState
from dora_systemd.adapters.journal.reader import LastEvent
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.ended import ended_row
from dora_systemd.verbs.facts.selector import OF_SYSTEM, Selector, find_all, runs_for_root
from dora_systemd.verbs.gateway import read_variables
from dora_systemd.verbs.top import Top
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

OTHER = "550e8400-0000-41d4-a716-446655440000"
THIRD = "abcdef00-0000-41d4-a716-446655440000"


@pytest.fixture
def cells() -> list[Cell]:
    manager = FakeManager()
    for name, uuid in (("robot", UUID), ("vision", OTHER), ("abcdef00", THIRD)):
        manager.add(options(name, uuid))
    return read_cells(manager)


@pytest.mark.parametrize(
    "selector",
    ["robot", "dora-robot.service", "dora-robot", UUID, UUID.upper(), UUID[:12], "550E8400-E"],
)
def test_selectors(cells: list[Cell], selector: str) -> None:
    assert Selector(selector).loaded(cells).name == "robot"


def test_a_name_wins_over_a_prefix(cells: list[Cell]) -> None:
    assert Selector("abcdef00").loaded(cells).uuid == THIRD


def test_a_name_wins_over_a_unit() -> None:
    manager = FakeManager()
    for name, uuid in (("robot", UUID), ("dora-robot", OTHER)):
        manager.add(options(name, uuid))
    assert Selector("dora-robot").find(manager).uuid == OTHER
    assert Selector("dora-dora-robot").find(manager).uuid == OTHER


@pytest.mark.parametrize(
    ("texts", "names"),
    [
        (["r*"], ["robot"]),
        (["*o*"], ["robot", "vision"]),
        (["dora-*.service"], ["robot", "vision", "abcdef00"]),
        (["[rv]*", "robot"], ["robot", "vision"]),
        (["robot"], ["robot"]),
    ],
)
def test_patterns(texts: list[str], names: list[str], tmp_path: Path) -> None:
    manager = FakeManager()
    for name, uuid in (("robot", UUID), ("vision", OTHER), ("abcdef00", THIRD)):
        manager.add(options(name, uuid))
    found = find_all(manager, ScopeIn(is_user=False, uid=0, root=tmp_path), texts)
    assert sorted(one.name for one in found) == sorted(names)
    with pytest.raises(DoraSystemdError, match="no dataflow named 'x"):
        find_all(manager, ScopeIn(is_user=False, uid=0, root=tmp_path), ["robot", "x*"])


def test_an_ambiguous_prefix_lists_what_it_fits(cells: list[Cell]) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        Selector("550e8400").loaded(cells)
    assert caught.value.code is ExitCode.USAGE
    assert f"{UUID} (robot)" in caught.value.hint
    assert f"{OTHER} (vision)" in caught.value.hint


KNOWN = "known dataflows: abcdef00, robot, vision"


@pytest.mark.parametrize(
    ("selector", "hint"),
    [
        ("robto", "did you mean robot?"),
        ("zzzz", KNOWN),
        ("550", f"{KNOWN}; the beginning of a UUID must have at least 4 characters"),
        ("bad", f"{KNOWN}; the beginning of a UUID must have at least 4 characters"),
        ("5x", KNOWN),
    ],
)
def test_nothing_fits(cells: list[Cell], selector: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        Selector(selector).loaded(cells)
    assert caught.value.code is ExitCode.NOT_FOUND
    assert caught.value.hint == hint


def test_a_foreign_unit_of_that_name_is_no_hint() -> None:
    known = ["robot", "vision"]
    assert Selector("vision").missing(known).hint == "known dataflows: robot"
    assert Selector("dora-robot.service").missing(known).hint == "known dataflows: vision"


def test_what_runs_for_root_is_named_to_other_users() -> None:
    """Without sudo a verb has no other way to find it."""
    asked: list[str] = []

    def is_of_system(names: Iterable[str]) -> bool:
        asked.extend(names)
        return True

    error = Selector("dora-robot").missing(["robto"], is_of_system)
    assert error.message == "no dataflow named 'dora-robot'"
    assert error.hint == OF_SYSTEM
    assert asked == ["dora-robot", "robot"]
    assert not runs_for_root(["no-such-dataflow", "/", "x" * 300])


@given(st.text())
def test_any_selector_is_answered(selector: str) -> None:
    manager = FakeManager()
    manager.add(options())
    try:
        assert Selector(selector).find(manager).name == "robot"
    except DoraSystemdError as error:
        assert error.message.startswith(("cannot", "no dataflow named"))


@pytest.mark.parametrize(
    ("selector", "fits"),
    [
        ("robot", True),
        ("dora-robot.service", True),
        (UUID, True),
        ("550E8400", True),
        ("550", False),
        ("robo", False),
        ("", False),
    ],
)
def test_selectors_of_ended_ones(selector: str, fits: bool) -> None:
    row = ended_row(LastEvent("robot", UUID, "dataflow-stopped", 1, ""))
    assert Selector(selector).meant([row]) == [row] * fits


def test_the_newest_one_that_has_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    names = (("other", THIRD), ("robot", UUID), ("robot", OTHER))
    scope = ScopeIn(is_user=True, uid=1000, root=tmp_path)
    records = [life_record("dataflow-stopped", 1, *one, scope=scope) for one in names]
    FakeJournal(monkeypatch, tmp_path).write(*records)
    events = [LastEvent(*one, "dataflow-stopped", 1, "") for one in names]
    assert Selector("robot").ended(scope) == ended_row(events[1])
    assert Selector("dora-other.service").ended(scope) == ended_row(events[0])
    assert Selector("nobody").ended(scope) is None


def test_one_that_ended_before_many_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    scope = ScopeIn(is_user=False, uid=0, root=tmp_path)
    names = [*(f"n{number}" for number in range(150)), "robot"]
    records = [life_record("dataflow-stopped", 1, name, scope=scope) for name in names]
    FakeJournal(monkeypatch, tmp_path).write(*records)
    found = Selector("robot").ended(scope)
    assert found == ended_row(LastEvent("robot", UUID, "dataflow-stopped", 1, ""))


NEEDS_IT: dict[str, Callable[[str, FakeManager, Scope], object]] = {
    "set": lambda text, manager, scope: Selector(text).find_present(manager, scope),
    "enable": lambda text, manager, scope: find_all(manager, scope, ["other", text]),
    "top": lambda text, manager, scope: Top(manager, scope, [text]),
    "env": lambda text, manager, scope: read_variables(manager, scope, text),
}
"""What asks for a dataflow that systemd has, as one of the verbs that do so in the same way."""


def test_what_has_ended_is_known_and_not_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A verb that needs it has nothing to do; "no dataflow named" is for what nobody knows."""
    scope, manager = ScopeIn(is_user=True, uid=1000, root=tmp_path), FakeManager()
    manager.add(options("other", THIRD))
    journal = FakeJournal(monkeypatch, tmp_path)
    journal.write(life_record("dataflow-stopped", 1, "robot", UUID, scope=scope))
    for text, need in product(("robot", UUID[:8]), NEEDS_IT.values()):
        with pytest.raises(DoraSystemdError, match="use the dataflow robot: it has end") as caught:
            need(text, manager, scope)
        assert (caught.value.code, caught.value.hint) == (
            ExitCode.NOT_RUNNING,
            "doractl start robot",
        )
    assert Selector("other").find_present(manager, scope).name == "other"
    with pytest.raises(DoraSystemdError, match="no dataflow named 'nobody'"):
        Selector("nobody").find_present(manager, scope)
    journal.complain("no permission")
    with pytest.raises(DoraSystemdError, match="no dataflow named 'robot'"):
        Selector("robot").find_present(manager, scope)


class Unloaded(FakeManager):
    """Units that are found by name only."""

    def list_units(self, pattern: str) -> list[UnitState]:
        del pattern
        return []


def test_a_unit_file_that_systemd_has_not_loaded() -> None:
    manager = Unloaded()
    unit = manager.add(options())
    for text in ("robot", "dora-robot.service"):
        assert Selector(text).find(manager).unit == unit
    with pytest.raises(DoraSystemdError, match="no dataflow named"):
        Selector(UUID[:8]).find(manager)
