"""What mutmut has found: which mutants the tests have killed, and what the others change."""

import ast
import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

# Exit statuses of pytest and of mutmut; what is not here was ended by a signal or timed out.
_OUTCOMES = {0: "survived", 5: "survived", 33: "survived", 1: "killed", 3: "killed"}
_TIMEOUT = "timeout"
_COLUMNS = ("killed", "survived", _TIMEOUT)
_NAME = re.compile(r"x_(?P<function>\w+)|xǁ(?P<class>\w+)ǁ(?P<method>\w+)")
_SUFFIX = re.compile(r"__mutmut_\w+$")


@dataclass(frozen=True)
class Mutant:
    """A change of one function. name: mutmut's. path: of the source, relative to the checkout."""

    name: str
    path: Path
    outcome: str  # "" if it has not run

    @property
    def folder(self) -> str:
        """The folder of the source, without the name of the package."""
        return str(Path(*self.path.parts[1:-1]))


@dataclass(frozen=True)
class Change:
    """What a mutant changes: the line of the source, and its text before and after."""

    line: int
    before: str
    after: str


def read_mutants(place: Path) -> list[Mutant]:
    """Read all mutants below `place`, mutmut's directory."""
    found = []
    for meta in sorted(place.rglob("*.py.meta")):
        path = meta.relative_to(place).with_suffix("")
        codes: dict[str, int | None] = json.loads(meta.read_text())["exit_code_by_key"]
        found += [Mutant(name, path, _outcome(code)) for name, code in codes.items()]
    return found


def _outcome(code: int | None) -> str:
    return "" if code is None else _OUTCOMES.get(code, _TIMEOUT)


def read_change(place: Path, checkout: Path, mutant: Mutant) -> Change:
    """Find the line that a mutant changes."""
    mutated = place / mutant.path
    spans = json.loads(mutated.with_name(f"{mutated.name}.spans").read_text())["spans"]
    lines = mutated.read_text(encoding="utf-8").split("\n")
    name = mutant.name.rpartition(".")[2]
    function = _SUFFIX.sub("", name)
    original, changed = (
        [line.replace(one, function) for line in lines[spans[one][0] - 1 : spans[one][1]]]
        for one in (f"{function}__mutmut_orig", name)
    )
    pairs = enumerate(zip_longest(original, changed, fillvalue=""))
    at, (before, after) = next((at, pair) for at, pair in pairs if pair[0] != pair[1])
    begin = next(at for at, line in enumerate(original) if line.lstrip().startswith(_DEF))
    source = (checkout / mutant.path).read_text(encoding="utf-8")
    return Change(find_line(source, function) + at - begin, before.strip(), after.strip())


_DEF = ("def ", "async def ")


def find_line(source: str, name: str) -> int:
    """Find the line of a function by mutmut's name for it: x_f, or xǁCǁf for a method f of C."""
    found = _NAME.fullmatch(name)
    assert found, name
    body: Iterable[ast.stmt] = ast.parse(source).body
    if found["class"]:
        classes = (n for n in body if isinstance(n, ast.ClassDef))
        body = next(n.body for n in classes if n.name == found["class"])
    wanted = found["function"] or found["method"]
    functions = (n for n in body if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    return next(n.lineno for n in functions if n.name == wanted)


def percent(counts: Counter[str]) -> float:
    """Return how many of the mutants the tests have noticed; one that hangs them is noticed."""
    return 100 * (counts["killed"] + counts[_TIMEOUT]) / max(counts.total(), 1)


def count(mutants: Iterable[Mutant]) -> Counter[str]:
    """Count the mutants that have run by their outcome."""
    return Counter(one.outcome for one in mutants if one.outcome)


def format_table(mutants: Sequence[Mutant]) -> str:
    """Return a table of the mutants that have run, by folder."""
    folders = dict.fromkeys(one.folder for one in mutants)
    rows = [("FOLDER", "MUTANTS", *(word.upper() for word in _COLUMNS), "PERCENT")]
    for folder in folders:
        rows.append(_row(folder, count(one for one in mutants if one.folder == folder)))
    rows.append(_row("all", count(mutants)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows
    )


def _row(folder: str, counts: Counter[str]) -> tuple[str, ...]:
    numbers = (counts.total(), *(counts[word] for word in _COLUMNS))
    return (folder, *map(str, numbers), f"{percent(counts):.1f}")
