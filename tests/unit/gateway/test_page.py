"""The files of the status page: they need no other host, and the browser is told so."""

import asyncio
import re
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.request import Answer, Request
from dora_systemd.decisions.views.dataflows import UP_WORDS
from dora_systemd.decisions.views.facts import NODE_FACTS, USAGE, NodeRow
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.gateway.routes import DIRECTORY, HEADERS, PREFIX, TYPES, page_routes
from dora_systemd.scope import Scope

FILES = sorted(path for path in DIRECTORY.rglob("*") if path.is_file())
SCRIPTS = [path for path in FILES if path.suffix == ".js"]


def get(path: str) -> Answer:
    async def ask() -> Answer:
        return await page_routes()[path](Request(path, Scope(False, 0)))

    return asyncio.run(ask())


def test_every_file_has_a_route_and_a_type() -> None:
    assert {path.suffix for path in FILES} <= TYPES.keys()
    names = {str(path.relative_to(DIRECTORY)) for path in FILES} - {"index.html"}
    assert page_routes().keys() == {"/", *(f"{PREFIX}{name}" for name in names)}


@pytest.mark.parametrize("path", sorted(page_routes()))
def test_answers(path: str) -> None:
    answer = get(path)
    name = path.removeprefix(PREFIX).strip("/") or "index.html"
    assert answer.status == 200
    assert answer.body == (DIRECTORY / name).read_bytes()
    assert answer.content_type == TYPES[Path(name).suffix]
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_nothing_comes_from_elsewhere(path: Path) -> None:
    text = path.read_text().replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|//[a-z]+\.[a-z]|@import|url\((?!#)", text)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_what_comes_from_outside_is_text(path: Path) -> None:
    """No way to markup or code is used at all."""
    text = path.read_text()
    wrong = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|Function\(|srcdoc"
    assert not re.search(wrong, text)
    assert not re.search(r"setAttribute\(\"on", text)


def test_the_page_has_no_code_of_its_own() -> None:
    """What the Content-Security-Policy forbids would silently not work."""
    text = (DIRECTORY / "index.html").read_text()
    assert not re.search(r"<style|\sstyle=|\son[a-z]+=|<script(?![^>]*src=)", text)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_what_is_asked_for_is_there(path: Path) -> None:
    text = path.read_text()
    wanted = re.findall(r'(?:src|href)="(/[^"#]+)"', text)
    known = {f"{PREFIX}{one.relative_to(DIRECTORY)}" for one in FILES}
    for name in re.findall(r'from "([^"]+)"', text):
        place = (path.parent / name).resolve()
        wanted.append(f"{PREFIX}{place.relative_to(DIRECTORY.resolve())}")
    assert set(wanted) <= known & {"/", *page_routes()}


def test_the_page_knows_which_dataflows_are_up() -> None:
    """It offers Stop for these, and Start for all others."""
    words = (DIRECTORY / "words.js").read_text()
    (listed,) = re.findall(r"const UP = \[([^]]+)\]", words)
    assert set(re.findall(r'"(\w+)"', listed)) == UP_WORDS
    (tones,) = re.findall(r"const TONES = \{([^}]+)\}", words)
    assert set(re.findall(r"(\w+):", tones)) >= {word.lower() for word in UP_WORDS}


def test_frames_are_refused() -> None:
    assert HEADERS["X-Frame-Options"] == "DENY"


FLOW = dataflow_object(DataflowRow("u", "robot", "unit", "Running", nodes=(NodeRow("a", "ready"),)))
NODE_KEYS = set(FLOW["nodes"][0])
FLOW_KEYS = {*FLOW, "isEnded"}
KEYS = {
    ("nodes.js", "facts"): NODE_KEYS,
    ("nodes.js", "signWords"): NODE_KEYS,
    ("words.js", "node"): NODE_KEYS,
    ("parts.js", "showUse"): {one.key for one in USAGE},
    ("cards.js", "flow"): FLOW_KEYS,
    ("detail.js", "flow"): FLOW_KEYS,
    ("detail.js", "row"): FLOW_KEYS | {"show"},
}
"""By script, and variable or function that takes one apart: the keys that it may name."""


def named_keys(script: str, name: str) -> set[str]:
    """The keys of an object that a script names."""
    text = (DIRECTORY / script).read_text()
    if name == "showUse":
        text, name = (
            text[text.index("function showUse") : text.index("function showState")],
            "facts",
        )
    dotted = re.findall(rf"\b{name}\??\.(\w+)", text)
    taken = re.findall(rf"\{{([^{{}}]*)\}} = {name};|function {name}\(\{{([^{{}}]*)\}}", text)
    listed = [part for groups in taken for part in "".join(groups).split(",")]
    return {*dotted, *(part.partition(":")[0].strip() for part in listed)}


@pytest.mark.parametrize(("script", "name"), KEYS)
def test_scripts_name_only_keys_of_the_table(script: str, name: str) -> None:
    named = named_keys(script, name)
    assert named
    assert named <= KEYS[script, name]


def test_the_table_has_all_keys() -> None:
    moments = {f"{one.key}_us" for one in NODE_FACTS if one.is_moment}
    assert {one.key for one in NODE_FACTS} | moments == NODE_KEYS
