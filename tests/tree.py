"""Writes what HACKING.md has from the code: the tree of folders, and what each state can become.

    python3 -m tests.tree

tests/unit/project/test_hacking.py compares.
"""

import ast
from pathlib import Path

from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.life.table import step
from tests.unit.decisions.life.test_table import EACH, cell

CHECKOUT = Path(__file__).resolve().parents[1]
HACKING = CHECKOUT / "HACKING.md"
LAYERS = ("decisions", "trust", "adapters", "verbs", "link", "runner", "gateway")
"""The folders of dora_systemd/, from the bottom up; below them are the words, beside them."""
WORDS = "words: modules that need the standard library only"
COLUMN = 21
SECTIONS = ("tree", "states")


def document(folder: Path) -> str:
    """The docstring of a package; "" if it has none."""
    return ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""


def tree() -> str:
    """The folders, each with the first line of its docstring."""
    package = CHECKOUT / "dora_systemd"
    names = " ".join(sorted(path.stem for path in package.glob("[a-z]*.py")))
    lines = ["dora_systemd/", f"  {names}", f"  {'':{COLUMN - 2}}{WORDS}"]
    for folder in (*(package / layer for layer in LAYERS), CHECKOUT / "cli"):
        lines += _lines(folder, 0 if folder.name == "cli" else 1)
    return "\n".join(["```", *lines, "```"])


def _lines(folder: Path, depth: int) -> list[str]:
    below = sorted(path.parent for path in folder.glob("*/__init__.py"))
    first = document(folder).partition("\n")[0]
    found = [f"{'  ' * depth}{folder.name}/".ljust(COLUMN) + first] if first else []
    return [*found, *(line for one in below for line in _lines(one, depth + 1))]


def states() -> str:
    """What each state of a cell can become."""
    rows = {
        state: {step(cell(state), event)[0].state for event in EACH} - {state} for state in State
    }
    return "\n".join(
        [
            "```",
            *(
                f"{state.value:10} -> {', '.join(one.value for one in State if one in after)}"
                for state, after in rows.items()
                if after
            ),
            "```",
        ]
    )


def written(text: str) -> str:
    """HACKING.md with the sections as the code has them."""
    for name, made in zip(SECTIONS, (tree(), states()), strict=True):
        before, begin, rest = text.partition(f"<!-- {name}: written by python3 -m tests.tree -->\n")
        _, end, after = rest.partition(f"<!-- end of {name} -->")
        assert begin and end, f"HACKING.md has no section {name}"
        text = f"{before}{begin}{made}\n{end}{after}"
    return text


if __name__ == "__main__":
    HACKING.write_text(written(HACKING.read_text()))
