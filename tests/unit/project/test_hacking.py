"""HACKING.md, and the texts of the folders, are true."""

import re
from pathlib import Path

from tests.tree import HACKING, document, written
from tests.unit.checkout import CHECKOUT

TOPS = (CHECKOUT / "dora_systemd", CHECKOUT / "cli")
FILES = [path for top in (*TOPS, CHECKOUT / "tests") for path in top.rglob("*.*")]
NAMES = {path.name for path in FILES}
PLACES = (CHECKOUT, CHECKOUT / "dora_systemd", CHECKOUT / "dora_systemd/decisions")
PATHS = re.compile(r"`([\w./-]+\.(?:py|pl|sh|js|json5|md))`")
MOST = 12_000
"""Bytes of HACKING.md: what is longer belongs to the folder that it is about."""


def packages() -> list[Path]:
    return sorted(one.parent for top in TOPS for one in top.rglob("__init__.py"))


def missing(text: str, beside: Path) -> list[str]:
    """The files that a text names and that are not there."""
    return [
        name
        for name in PATHS.findall(text)
        if name not in NAMES and not any((place / name).exists() for place in (beside, *PLACES))
    ]


def test_tree_and_states_are_those_of_the_code() -> None:
    text = HACKING.read_text()
    assert text == written(text), "run: python3 -m tests.tree"


def test_it_is_a_guide() -> None:
    assert len(HACKING.read_bytes()) < MOST, "what is about one folder goes to its __init__.py"


def test_what_it_names_is_there() -> None:
    assert missing(HACKING.read_text(), CHECKOUT) == []


def test_what_folders_name_is_there() -> None:
    found = {str(one): missing(document(one), one) for one in packages()}
    assert not {name: files for name, files in found.items() if files}


def test_every_folder_says_what_it_is_for() -> None:
    sections = CHECKOUT / "cli/verbs"
    bare = [one for one in packages() if not document(one) and one.parent != sections]
    assert not bare, "its __init__.py has no docstring"
