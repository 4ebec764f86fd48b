"""Finds the files of a project that a Python program consists of, by its import statements.

Hot reload restarts a node when one of these files changes. program_files() parses the script,
follows each import statement to files that exist, and then the imports of those files. No code of
the project runs. program_files() reads files only through the given `read`, which decides what
belongs to the project. The rules of the search are those of Python's import system:
https://docs.python.org/3/reference/import.html

The result can have too many files, which costs a restart: `from a import b` counts a file a/b.py
although b may be a name in a, and a module counts in every directory that has it, although Python
takes the first. It has too few where a program imports by a computed name (importlib, plug-ins) or
changes sys.path: the node's `watch` patterns are for these.
"""

import ast
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import PurePath

Read = Callable[[str], str | None]
"""The text of a file, or None if there is no such file."""

_NOT_PARSED = (SyntaxError, ValueError, RecursionError, MemoryError)
"""What Python raises for a source; the last two for one that is nested too deeply."""


def program_files(script: str, read: Read, places: Iterable[str] = ()) -> frozenset[str]:
    """The absolute paths of `script` and of all modules of the project that it imports.

    places: directories to search besides that of the script, such as those of PYTHONPATH. Modules
    that are in none of them, such as the standard library's, do not belong to the project.
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
    except _NOT_PARSED:
        return  # the file itself still counts, so a corrected version is noticed
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
    """The files that an import of `names` may execute, with those of the packages above it."""
    for base in bases:
        for length in range(1, len(names) + 1):
            place = base.joinpath(*names[:length])
            yield str(place / "__init__.py")
            yield f"{place}.py"
        if not names:
            yield str(base / "__init__.py")


def syntax_error(path: str, source: str) -> str:
    """The error in a Python file, such as "line 3: invalid syntax", or "" if it compiles."""
    try:
        compile(source, path, "exec", dont_inherit=True)
    except SyntaxError as error:
        return f"line {error.lineno}: {error.msg}"
    except _NOT_PARSED as error:
        return str(error) or "it is too complex for Python"
    return ""
