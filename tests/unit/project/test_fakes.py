"""A fake that inherits a class runs the `__init__` of that class: no method finds half an object.

Otherwise it stands behind a Protocol, or the real class stands on fake ends.
"""

import ast
from collections.abc import Iterator

import pytest

from tests.unit.checkout import CHECKOUT
from tests.unit.project.test_patches import imported_from_ours, root_of


def find_halves(text: str) -> Iterator[tuple[int, str]]:
    """Line and name of each class whose base is ours, with an `__init__` that calls no other."""
    tree = ast.parse(text)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    ours = imported_from_ours(tree) | {one.name for one in classes}
    for one in classes:
        made = [node for node in one.body if _is_init(node)]
        if made and any(root_of(base) in ours for base in one.bases) and not _calls_init(made[0]):
            yield one.lineno, one.name


def _is_init(node: ast.stmt) -> bool:
    return isinstance(node, ast.FunctionDef) and node.name == "__init__"


def _calls_init(function: ast.stmt) -> bool:
    calls = (node.func for node in ast.walk(function) if isinstance(node, ast.Call))
    return any(isinstance(one, ast.Attribute) and one.attr == "__init__" for one in calls)


def test_no_fake_is_half_an_object() -> None:
    found = [
        f"{path.relative_to(CHECKOUT)}:{line} {name}"
        for path in sorted((CHECKOUT / "tests").rglob("*.py"))
        for line, name in find_halves(path.read_text())
    ]
    if found:
        message = "these inherit a class of ours, but not its __init__ (hint: use a Protocol)"
        pytest.fail("\n".join([message, *found]), pytrace=False)


IMPORTS = """
import asyncio
from dora_systemd.verbs import list as module
from dora_systemd.scope import Scope
class Local: pass
"""
INIT = "\n    def __init__(self): "


@pytest.mark.parametrize(
    ("text", "is_found"),
    [
        (f"class Fake(Scope):{INIT}self.x = 1", True),
        (f"class Fake(module.Inner):{INIT}self.x = 1", True),
        (f"class Fake(Scope[int]):{INIT}self.x = 1", True),
        (f"class Fake(Local):{INIT}self.x = 1", True),
        (f"def test():\n  class Fake(asyncio.Queue, Scope):{INIT}self.x = 1", True),
        (f"class Fake(Scope):{INIT}super().__init__(1)", False),
        (f"class Fake(Scope):{INIT}Scope.__init__(self, 1)", False),
        ("class Fake(Scope): x = 1", False),
        (f"class Fake:{INIT}self.x = 1", False),
        (f"class Fake(asyncio.Queue):{INIT}self.x = 1", False),
    ],
)
def test_what_counts(text: str, is_found: bool) -> None:
    assert bool(list(find_halves(IMPORTS + text))) is is_found
