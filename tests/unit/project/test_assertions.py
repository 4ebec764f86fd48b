"""Every unit test can fail: it asserts something, or expects an exception.

A test that only calls something fails by an exception, and says nothing about what was done.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.unit.checkout import CHECKOUT

CHECKS = {"raises", "warns", "fail"}
"""Of pytest."""

ELSEWHERE = {"tests/unit/test_fuzz.py::test_new_inputs_break_nothing"}
"""What they call as an attribute asserts: a target in tests/fuzz."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def find_idle(path: Path) -> Iterator[str]:
    """The tests of a module that assert nothing, not even in a function of the tests."""
    functions = (node for node in ast.walk(parse(path)) if isinstance(node, Function))
    for one in functions:
        if one.name.startswith("test_") and not asserts(path, one):
            yield one.name


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def asserts(path: Path, function: ast.AST, above: tuple[str, ...] = ()) -> bool:
    """Whether a function does, in what is defined in it, or in what it calls by name.

    above: the functions that have called it.
    """
    nodes = list(ast.walk(function))
    if any(isinstance(node, ast.Assert) for node in nodes):
        return True
    calls = [node.func for node in nodes if isinstance(node, ast.Call)]
    if any(isinstance(one, ast.Attribute) and one.attr in CHECKS for one in calls):
        return True
    names = {one.id for one in calls if isinstance(one, ast.Name)} - {*above}
    found = (find_function(path, name) for name in sorted(names))
    return any(asserts(*one, (*above, one[1].name)) for one in found if one)


def find_function(path: Path, name: str) -> tuple[Path, Function] | None:
    """A function of a module, or one of the tests that it imports."""
    for node in parse(path).body:
        if isinstance(node, Function) and node.name == name:
            return path, node
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests."):
            for one in node.names:
                if name == (one.asname or one.name):
                    return find_function(path_of(path, node.module or ""), one.name)
    return None


def path_of(importer: Path, module: str) -> Path:
    """The file of a module of the tests, which another one imports."""
    top = next(one.parent for one in importer.parents if one.name == "tests")
    return top / f"{module.replace('.', '/')}.py"


def test_every_test_asserts_something() -> None:
    tests = sorted((CHECKOUT / "tests/unit").rglob("test_*.py"))
    found = [f"{path.relative_to(CHECKOUT)}::{name}" for path in tests for name in find_idle(path)]
    found = [one for one in found if one not in ELSEWHERE]
    if found:
        message = f"{len(found)} tests assert nothing (hint: say what is there after it)"
        pytest.fail("\n".join([message, *found]), pytrace=False)


HEAD = """
from tests.helper import check as judge, do
def here(): assert done
def deep(): here()
def again(): again()
def test_it(bench):
"""
HELPER = "def check(): assert done\ndef do(): pass\n"


@pytest.mark.parametrize(
    ("text", "is_idle"),
    [
        (" assert done", False),
        (" with pytest.raises(ValueError): bench.do()", False),
        (" pytest.fail()", False),
        (" here()", False),
        (" deep()", False),
        (" judge()", False),
        (" def inner(): here()\n asyncio.run(inner())", False),
        (" do()", True),
        (" again()", True),
        (" here", True),
        (" bench.here()", True),
        (" done == 1", True),
    ],
)
def test_what_counts(text: str, is_idle: bool, tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/helper.py").write_text(HELPER)
    module = tmp_path / "tests/test_module.py"
    module.write_text(f"{HEAD}{text}\n")
    assert [*find_idle(module)] == ["test_it"] * is_idle
