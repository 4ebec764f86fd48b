"""Which files of a project a Python program is made of, found by its import statements.

What is imported by name only at run time (importlib, plug-ins) is not found; a node's `watch`
patterns are for that. See the reference of the import system, docs of Python.
"""

import ast
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import PurePath

Read = Callable[[str], str | None]
"""The text of a file, or None if there is no such file."""


def program_files(script: str, read: Read, places: Iterable[str] = ()) -> frozenset[str]:
    """The absolute paths of `script` and of all modules of the project that it imports.

    As Python does, modules are looked for in the directory of the script, and then in `places`
    (PYTHONPATH, say); those that are not there come from elsewhere: they are not the project's.
    """
    roots = [PurePath(script).parent, *map(PurePath, places)]
    found: set[str] = set()
    waiting = deque([script])
    while waiting:
        path = waiting.popleft()
        if path in found or (source := read(path)) is None:
            continue
        found.add(path)
        waiting.extend(_imported(PurePath(path), source, roots))
    return frozenset(found)


def _imported(path: PurePath, source: str, roots: Sequence[PurePath]) -> Iterator[str]:
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return
    for statement in ast.walk(tree):
        if isinstance(statement, ast.Import):
            for alias in statement.names:
                yield from _candidates(roots, alias.name.split("."))
        elif isinstance(statement, ast.ImportFrom):
            bases = [_parent(path, statement.level)] if statement.level else roots
            names = statement.module.split(".") if statement.module else []
            yield from _candidates(bases, names)
            for alias in statement.names:
                yield from _candidates(bases, [*names, alias.name])


def _parent(path: PurePath, level: int) -> PurePath:
    return path.parents[min(level, len(path.parents)) - 1]


def _candidates(bases: Iterable[PurePath], names: list[str]) -> Iterator[str]:
    """Where `names` may be: each package on the way is executed, too."""
    for base in bases:
        for length in range(1, len(names) + 1):
            place = base.joinpath(*names[:length])
            yield str(place / "__init__.py")
            yield f"{place}.py"
        if not names:
            yield str(base / "__init__.py")


def syntax_error(path: str, source: str) -> str:
    """What is wrong with a Python file, as "line 3: invalid syntax", or "" if it compiles."""
    try:
        compile(source, path, "exec", dont_inherit=True)
    except SyntaxError as error:
        return f"line {error.lineno}: {error.msg}"
    except ValueError as error:
        return str(error)
    return ""
