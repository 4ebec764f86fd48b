"""Finds what a build has left, and checks that a release can have it.

All of it belongs to the release, for nobody knows what the nodes need: without repositories, what
is no program in a cache, and bytecode that the interpreter would not use. The build can have left
anything.
"""

import posixpath
import stat
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dora_systemd.decisions.releases.entries import (
    DIRECTORY,
    FILE,
    LINK,
    MOST_FILES,
    Found,
    check_amount,
    check_found,
    is_plain_path,
    refusal,
    too_many,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.paths import reached
from dora_systemd.trust.project import Project

_VENV, _CACHE = "pyvenv.cfg", "CACHEDIR.TAG"
"""Files whose directory is a virtual environment, or a cache such as Cargo's `target`."""
_HINT = "the build has left it: have the build remove it, or make something else of it"
_PYTHON_HINT = (
    "create the virtual environment with a Python of the system, such as /usr/bin/python3"
)
_LEFT_OUT = (".git", "__pycache__")
_LEFT_OUT_OF_CACHE = (*_LEFT_OUT, "build", "deps", "examples", "incremental", ".fingerprint")


def find_built(
    project: Project, named: Sequence[str], tree: Path, is_user: bool
) -> dict[str, Found]:
    """The files of a built release by path.

    named: paths that belong to it although they are in a cache, such as Cargo's target. tree: where
    the files will be. Raises DoraSystemdError (BAD_INPUT) for what a release cannot have.
    """
    try:
        return _checked(project, named, tree, is_user)
    except DoraSystemdError as error:
        if error.code is not ExitCode.BAD_INPUT or error.hint == _PYTHON_HINT:
            raise
        # Not the hint for a file of the project.
        raise DoraSystemdError(error.message, _HINT, error.code) from error


def _checked(project: Project, named: Sequence[str], tree: Path, is_user: bool) -> dict[str, Found]:
    found, venvs = _walk(project)
    for row in project.facts(named) if named else ():
        if row is not None and row[1] != DIRECTORY and not _is_behind_link(row[0], found):
            found[row[0]] = Found(*row)
    if len(found) > MOST_FILES:
        raise too_many("")
    for one in found.values():
        if not _is_interpreter(one, venvs, is_user):
            check_found(_relative(one, tree))
    check_amount(found.values())
    return dict(sorted(found.items()))


def _walk(project: Project) -> tuple[dict[str, Found], set[str]]:
    """All files, and the directories that are virtual environments."""
    found: dict[str, Found] = {}
    venvs: set[str] = set()
    queue = [("", "")]
    for directory, above in queue:
        entries = [Found(*row) for row in project.listed(directory, MOST_FILES + 1)]
        names = {posixpath.basename(one.path) for one in entries if one.kind == FILE}
        what = above or next((mark for mark in (_VENV, _CACHE) if mark in names), "")
        venvs |= {directory} if _VENV in names else set()
        for one in entries:
            if not _is_left_out(one, what):
                queue += [(one.path, what)] if one.kind == DIRECTORY else []
                found |= {one.path: one} if one.kind != DIRECTORY else {}
        if len(found) + len(queue) > MOST_FILES:
            raise too_many(directory)
    return found, venvs


def _is_left_out(one: Found, what: str) -> bool:
    """Whether no release needs it. what: _VENV or _CACHE if it is in such a directory."""
    if what == _CACHE and one.kind == FILE:
        return not one.is_executable
    names = {_VENV: (), _CACHE: _LEFT_OUT_OF_CACHE}.get(what, _LEFT_OUT)
    return one.kind == DIRECTORY and posixpath.basename(one.path) in names


def _is_behind_link(path: str, found: Mapping[str, Found]) -> bool:
    """Whether a link that the release has leads to it."""
    parts = path.split("/")
    return any("/".join(parts[:count]) in found for count in range(1, len(parts)))


def _relative(one: Found, tree: Path) -> Found:
    """The file, with an absolute target in the tree as a relative one."""
    if one.kind != LINK or not f"{one.target}/".startswith(f"{tree}/"):
        return one
    inside = one.target.removeprefix(str(tree)).lstrip("/")
    if ".." in inside.split("/"):
        return one
    return replace(one, target=posixpath.relpath(inside or ".", posixpath.dirname(one.path) or "."))


def _is_interpreter(one: Found, venvs: set[str], is_user: bool) -> bool:
    """Whether it is the link of a virtual environment to its Python.

    Raises DoraSystemdError (BAD_INPUT) if others than root can change that Python: it would be a
    part of the release that changes.
    """
    place, name = posixpath.split(one.path)
    venv = posixpath.dirname(place)
    is_python = posixpath.basename(place) == "bin" and name.startswith("python")
    is_one = one.kind == LINK and is_python and venv in venvs and is_plain_path(one.path)
    is_one = is_one and one.target.startswith("/")
    if is_one and one.path.isprintable() and one.target.isprintable():
        if is_user or _is_roots(one.target):
            return True
        reason = f"it links to {one.target}, which others than root can change"
        raise refusal(one.path, reason, _PYTHON_HINT)
    return False


def _is_roots(path: str) -> bool:
    try:
        with reached(path) as (_, place):
            # Not a directory: what is behind it could be a link of anybody.
            is_program = stat.S_ISREG(place.mode) and not path.startswith(("/proc/", "/dev/"))
            return place.is_roots and is_program
    except (OSError, DoraSystemdError):
        return False
