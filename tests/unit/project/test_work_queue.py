"""The queue of test modules, from which the containers of `make test` take their work."""

from dataclasses import dataclass
from pathlib import Path

from tests.system.usage import SHOWN, Usage
from tests.system.work_queue import longest_first, take_items


@dataclass(frozen=True)
class One:
    """A test of a module."""

    name: str
    path: Path


def items(*names: str) -> list[One]:
    return [One(name, Path(f"/src/tests/system/test_{name[0]}.py")) for name in names]


def test_each_module_is_run_by_one_and_all_are_run(tmp_path: Path) -> None:
    tests = items("a1", "a2", "b1", "c1", "c2")
    first, second = take_items(tests, tmp_path), take_items(tests, tmp_path)
    begun = [next(first), next(second)]
    assert [one.name for one in begun] == ["a1", "b1"]
    assert [one.name for one in first] == ["a2", "c1", "c2"]
    assert list(second) == []


def test_a_module_is_whole_though_its_tests_lie_apart(tmp_path: Path) -> None:
    taken = take_items(items("a1", "b1", "a2"), tmp_path)
    assert [one.name for one in taken] == ["a1", "a2", "b1"]


def test_modules_of_the_same_name_are_two(tmp_path: Path) -> None:
    others = [One("x", Path("/src/tests/system/deploy/test_a.py")), *items("a1")]
    assert len(list(take_items(others, tmp_path))) == 2


def test_the_longest_come_first() -> None:
    ordered = longest_first(items("a1", "b1", "b2", "c1"), ["test_c", "test_b"])
    assert [one.name for one in ordered] == ["c1", "b1", "b2", "a1"]


def test_what_modules_take(tmp_path: Path) -> None:
    stat = tmp_path / "cpu.stat"
    stat.write_text("usage_usec 1000000\nuser_usec 7\n")
    usage = Usage(stat)
    for name, used in (("one", 3_000_000), ("two", 3_500_000), ("one", 4_000_000)):
        with usage.of(name):
            stat.write_text(f"usage_usec {used}\n")
    lines = [line.split() for line in usage.lines()]
    assert {(line[-1], line[2]) for line in lines} == {
        ("one", "2.5"),
        ("two", "0.5"),
        ("modules", "3.0"),
    }
    stat.unlink()
    for number in range(SHOWN + 1):
        with usage.of(f"more-{number}"):
            pass
    assert len(usage.lines()) == SHOWN + 1, "and nobody counts here"
