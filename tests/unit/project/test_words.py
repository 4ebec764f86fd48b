"""Plain English in what a user reads: HACKING.md, "Words", has the rules."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.checkout import CHECKOUT

SMELLS = (
    *("anew", "seldomer", "mend", "hinders", "what became of", "for want of"),
    *("who asks", "who wants", "there are no,", "there are {", "is no end", "is no error"),
    *("stays away", "others run on", "runs on without", "goes on starting", "takes it back"),
    *("cannot go on", "so much at once", "nobody is there", "gets short", "root's word"),
)
PATTERN = re.compile("|".join(rf"(?<!\w){re.escape(one)}(?!\w)" for one in SMELLS), re.I)
TEXTS = (
    CHECKOUT / "README.md",
    # style.md has examples of what not to write.
    *sorted(path for path in (CHECKOUT / "docs").glob("*.md") if path.name != "style.md"),
    CHECKOUT / "units/templates/dora-systemd.catalog",
    *sorted((CHECKOUT / "packaging/man").iterdir()),
    *sorted((CHECKOUT / "dora_systemd/gateway/static").glob("*.html")),
)
MODULES = sorted([*CHECKOUT.glob("cli/**/*.py"), *CHECKOUT.glob("dora_systemd/**/*.py")])


def strings(source: str) -> Iterator[str]:
    """String literals without documentation; of f-strings the text, {} for what is filled in.

    A docstring below a decorator of click is a help text, and so counts.
    """
    nodes = list(ast.walk(ast.parse(source)))
    values = {id(one.value) for one in nodes if isinstance(one, ast.Expr)}
    inner = {id(one) for node in nodes if isinstance(node, ast.JoinedStr) for one in node.values}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            yield "".join(
                str(one.value) if isinstance(one, ast.Constant) else "{}" for one in node.values
            )
        elif isinstance(node, ast.FunctionDef) and any(
            "click." in ast.unparse(one) for one in node.decorator_list
        ):
            yield ast.get_docstring(node) or ""
        elif isinstance(node, ast.Constant) and id(node) not in values | inner:
            yield node.value if isinstance(node.value, str) else ""


def smells(text: str) -> list[str]:
    return [one[0] for one in PATTERN.finditer(re.sub(r"\s+", " ", text))]


def test_what_counts() -> None:
    source = '''
"""Said anew."""
first = "hint: there are no, on-failure"
second = f"{first} goes on starting: {first}"
third = f"there are {first}"
"""Counted anew."""

@click.command()
def verb():
    """What became of it."""

def helper():
    """Who asks."""  # anew
    return "amend, recommended"
'''
    found = [one for text in strings(source) for one in smells(text)]
    assert sorted(found) == ["What became of", "goes on starting", "there are no,", "there are {"]


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_texts(path: Path) -> None:
    assert smells(path.read_text()) == []


def test_string_literals() -> None:
    found = {
        str(path.relative_to(CHECKOUT)): bad
        for path in MODULES
        if (bad := [one for text in strings(path.read_text()) for one in smells(text)])
    }
    assert found == {}
