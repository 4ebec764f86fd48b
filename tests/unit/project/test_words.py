"""Plain English in what users and developers read: HACKING.md, "Words", has the rules."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.checkout import CHECKOUT

SMELLS = (
    *("anew", "seldomer", "mend", "hinders", "what became of", "for want of"),
    *("who asks", "who wants", "there are no,", "there are {", "is no end", "is no error"),
    *("stays away", "others run on", "runs on without", "goes on starting", "takes it back"),
    *("cannot go on", "so much at once", "nobody is there", "gets short", "root's word"),
    *("tells more", "tells what", "tells which", "tells of", "to tell", "cannot tell", "look for"),
)
RIDDLES = (
    # In comments and docstrings: report, notify, send, receive, request, read, record.
    *("tell", "tells", "told", "say", "says", "said", "saying", "hear", "hears", "heard"),
    *("asks", "asked for", "asks for", "ask for", "talking", "note that", "noted"),
    # Continue, next to, human-readable, on the host, again, repair.
    *("go on", "goes on", "going on", "went on", "without end", "in peace", "beside"),
    *("for people", "over there", "anew", "mend", "mended", "what became of", "for want of"),
    # Who, what, and how do they end?
    *("somebody", "whosever", "what is none", "stranger", "without a word", "last words"),
    *("of no use", "for good", "seldom", "look at", "looks at", "looked at"),
)


def pattern_of(phrases: tuple[str, ...]) -> re.Pattern[str]:
    return re.compile("|".join(rf"(?<![\w-]){re.escape(one)}(?!\w)" for one in phrases), re.I)


PATTERN, RIDDLE = pattern_of(SMELLS), pattern_of(RIDDLES)
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


def documentation(source: str) -> Iterator[str]:
    """Comments, and docstrings that are no help text, without what is `code`."""
    nodes = list(ast.walk(ast.parse(source)))
    helps = {
        id(node.body[0])
        for node in nodes
        if isinstance(node, ast.FunctionDef)
        and any("command(" in ast.unparse(one) for one in node.decorator_list)
    }
    plain = (one for one in nodes if isinstance(one, ast.Expr) and id(one) not in helps)
    texts = [str(one.value.value) for one in plain if isinstance(one.value, ast.Constant)]
    yield from (re.sub(r"`[^`]*`", "", one) for one in (*texts, comments(source)))


def comments(source: str) -> str:
    """All comments; those of lines that follow each other are one text."""
    text, last = "", 0
    for one in tokenize.generate_tokens(io.StringIO(source).readline):
        if one.type == tokenize.COMMENT:
            text += f"{' ' if one.start[0] == last + 1 else ' | '}{one.string.lstrip('# ')}"
            last = one.start[0]
    return text


def smells(text: str, pattern: re.Pattern[str] = PATTERN) -> list[str]:
    return [one[0] for one in pattern.finditer(re.sub(r"\s+", " ", text))]


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
    """Who asks. `beside`: stop-asked for all, retold."""  # anew
    first = ask()  # This line does not go
    # on, but beside
    return "amend, recommended"
    # people is for
'''
    found = [one for text in strings(source) for one in smells(text)]
    assert sorted(found) == ["What became of", "goes on starting", "there are no,", "there are {"]
    riddles = [one for text in documentation(source) for one in smells(text, RIDDLE)]
    assert sorted(riddles) == ["Said", "anew", "anew", "anew", "asks", "beside", "go on"]


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


def test_documentation() -> None:
    found = {
        str(path.relative_to(CHECKOUT)): bad
        for path in MODULES
        if (bad := [x for text in documentation(path.read_text()) for x in smells(text, RIDDLE)])
    }
    assert found == {}, "say who does what: report, receive, request, record, in parallel"
