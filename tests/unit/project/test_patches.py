"""Tests replace nothing of ours: they use fakes, which stand behind a Protocol or a parameter.

What others own may be replaced: programs on $PATH, systemd's libraries, the clock, the kernel.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.checkout import CHECKOUT

MAX = 15
"""Each one left is a door to the outside for which a parameter would be worse to read."""

OURS = ("dora_systemd", "tests")

PATCHES = {"setattr", "delattr", "setitem", "delitem", "patch", "object"}
"""Of pytest's MonkeyPatch, of unittest.mock, and of Python itself."""

METHOD = "method-assign"
"""What mypy calls the replacement of a method, wherever the object is from."""


def find_patches(text: str) -> Iterator[int]:
    """The lines of a module that replace something of ours."""
    tree = ast.parse(text)
    ours = imported_from_ours(tree)
    ours |= _looped(tree, ours)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _called(node.func) in PATCHES and node.args:
            if root_of(node.args[0]) in ours or _is_path_of_ours(node.args[0]):
                yield node.lineno
        elif isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(root_of(one) in ours for one in targets if not isinstance(one, ast.Name)):
                yield node.lineno
    yield from (n for n, line in enumerate(text.splitlines(), 1) if METHOD in line)


def imported_from_ours(tree: ast.Module) -> set[str]:
    """The names that a module imports from ours."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and _is_ours(node.module or ""):
            found |= {one.asname or one.name for one in node.names}
        elif isinstance(node, ast.Import):
            names = [one for one in node.names if _is_ours(one.name)]
            found |= {one.asname or one.name.partition(".")[0] for one in names}
    return found


def _looped(tree: ast.Module, ours: set[str]) -> set[str]:
    """The variables of loops over modules of ours."""
    loops = (node for node in ast.walk(tree) if isinstance(node, ast.For | ast.comprehension))
    return {
        loop.target.id
        for loop in loops
        if isinstance(loop.target, ast.Name) and isinstance(loop.iter, ast.Tuple | ast.List)
        if any(root_of(one) in ours for one in loop.iter.elts)
    }


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] in OURS


def _is_path_of_ours(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and _is_ours(node.value)


def _called(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def root_of(node: ast.expr) -> str:
    """The first name in `a.b.c` or `a.b["c"]`."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def test_tests_replace_nothing_of_ours() -> None:
    found = [
        f"{path.relative_to(CHECKOUT)}:{line}"
        for path in sorted((CHECKOUT / "tests").rglob("*.py"))
        if path != Path(__file__)
        for line in sorted(find_patches(path.read_text()))
    ]
    if len(found) > MAX:
        message = f"{len(found)} patches of our own modules, at most {MAX}: use a fake instead"
        pytest.fail("\n".join([message, *found]), pytrace=False)


IMPORTS = """
import os
import dora_systemd.scope
from dora_systemd.verbs import list as module
from dora_systemd.scope import Scope
"""


@pytest.mark.parametrize(
    ("line", "is_found"),
    [
        ('patch.setattr(module, "x", 1)', True),
        ('patch.setattr(module.Inner, "x", 1)', True),
        ('patch.setattr(Scope, "x", 1)', True),
        ('patch.setattr("dora_systemd.scope.Scope", 1)', True),
        ('patch.setattr("os.environ", 1)', False),
        ('patch.setitem(module.TABLE, "x", 1)', True),
        ('setattr(dora_systemd.scope, "x", 1)', True),
        ('mock.patch("dora_systemd.scope.Scope")', True),
        ('mock.patch.object(Scope, "x")', True),
        ("module.LIMIT = 1", True),
        ('module.TABLE["x"] = 1', True),
        ("module = 1", False),
        ('for one in (os, module): patch.setattr(one, "x", 1)', True),
        ('patch.setattr(os, "access", 1)', False),
        ('patch.setattr(fake, "x", 1)', False),
        (f"fake.x = 1  # type: ignore[assignment, {METHOD}]", True),
        ("fake.x = 1", False),
    ],
)
def test_what_counts(line: str, is_found: bool) -> None:
    assert bool(list(find_patches(IMPORTS + line))) is is_found
