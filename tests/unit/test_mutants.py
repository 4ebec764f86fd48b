"""What is read of the files that mutmut writes, and the table that is printed."""

import json
import re
import sys
from pathlib import Path

import pytest

from tests.mutants import fresh
from tests.mutants.__main__ import FOLDERS, TEXTS, add_tests
from tests.mutants.kept import KEPT, find_reason
from tests.mutants.outcome import Change, Mutant, find_line, format_table, read_change, read_mutants
from tests.unit.checkout import CHECKOUT

SOURCE = '''"""A module."""


def above() -> int:
    return 1


class Gate:
    @property
    def above(self) -> int:
        return 2

    async def run(
        self, soak: int
    ) -> int:
        # Why.
        return soak + 1
'''
MUTATED = """
    async def xǁGateǁrun__mutmut_orig(
        self, soak: int
    ) -> int:
        # Why.
        return soak + 1
    async def xǁGateǁrun__mutmut_12(
        self, soak: int
    ) -> int:
        # Why.
        return soak - 1
"""
PATH = Path("dora_systemd/trust/gate.py")
NAME = "dora_systemd.trust.gate.xǁGateǁrun__mutmut_12"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """mutmut's directory in a checkout with one source."""
    place = tmp_path / "mutants"
    for path, text in ((tmp_path / PATH, SOURCE), (place / PATH, MUTATED)):
        path.parent.mkdir(parents=True)
        path.write_text(text)
    spans = {"xǁGateǁrun__mutmut_orig": (2, 6), "xǁGateǁrun__mutmut_12": (7, 11)}
    (place / f"{PATH}.spans").write_text(json.dumps({"version": 1, "spans": spans}))
    codes = {NAME: 0, "a.x_b__mutmut_1": 1, "a.x_b__mutmut_2": -24, "a.x_b__mutmut_3": None}
    (place / f"{PATH}.meta").write_text(json.dumps({"exit_code_by_key": codes}))
    return place


def test_what_has_become_of_them(place: Path) -> None:
    mutants = read_mutants(place)
    assert [one.outcome for one in mutants] == ["survived", "killed", "timeout", ""]
    assert {(one.path, one.folder) for one in mutants} == {(PATH, "trust")}
    other = Mutant("x", Path("dora_systemd/verbs/releases/soak.py"), "killed")
    assert format_table([*mutants, other]) == (
        "FOLDER          MUTANTS  KILLED  SURVIVED  TIMEOUT  PERCENT\n"
        "trust                 3       1         1        1     66.7\n"
        "verbs/releases        1       1         0        0    100.0\n"
        "all                   4       2         1        1     75.0"
    )


def test_what_a_mutant_changes(place: Path) -> None:
    mutant = Mutant(NAME, PATH, "survived")
    change = Change(17, "return soak + 1", "return soak - 1")
    assert read_change(place, place.parent, mutant) == change


@pytest.mark.parametrize(("name", "line"), [("x_above", 4), ("xǁGateǁabove", 10)])
def test_where_a_function_is(name: str, line: int) -> None:
    assert find_line(SOURCE, name) == line


def test_a_function_has_the_tests_of_its_module(tmp_path: Path) -> None:
    file = tmp_path / "stats.json"
    tests = ["tests/unit/trust/test_gate.py::test_a", "tests/unit/trust/test_other.py::test_b"]
    called = {"dora_systemd.trust.gate.x_called": tests[1:]}
    stats = {"tests_by_mangled_function_name": called, "duration_by_test": dict.fromkeys(tests, 1)}
    file.write_text(json.dumps(stats))
    names = [NAME, "dora_systemd.trust.gate.x_called__mutmut_1"]
    add_tests(file, [Mutant(name, PATH, "") for name in names])
    found = json.loads(file.read_text())["tests_by_mangled_function_name"]
    gate, other = tests
    function = NAME.removesuffix("__mutmut_12")
    assert found == {"dora_systemd.trust.gate.x_called": [other, gate], function: [gate]}


def test_the_tables_of_tests_are_made_again_for_each_mutant() -> None:
    before = dict(sys.modules)
    try:
        fresh.pytest_configure()
        gone = before.keys() - sys.modules.keys()
    finally:
        sys.modules.update(before)
    assert __name__ in gone
    assert all(one.rpartition(".")[2].startswith("test_") for one in gone)


def test_the_folders_and_their_tests_are_there() -> None:
    for folder in FOLDERS:
        assert (CHECKOUT / "dora_systemd" / folder).is_dir()
        assert (CHECKOUT / "tests/unit" / folder).is_dir()
    # What a child process runs is a program of its own.
    modules = (CHECKOUT / "dora_systemd/trust").glob("*.py")
    programs = {f"trust/{one.name}" for one in modules if "__main__" in one.read_text()}
    assert set(TEXTS) == programs


def test_each_survivor_that_stays_has_a_reason() -> None:
    assert find_reason("a.py", 'open(x, encoding="utf-8")', "open(x, )") == KEPT[0].reason
    assert find_reason("a.py", "return 1", "return 2") == ""
    for one in KEPT:
        assert one.reason
        re.compile(one.change)
        assert any(re.search(one.path, str(path)) for path in CHECKOUT.glob("dora_systemd/**/*.py"))
