"""Finds the project that `uv run` works in, by the rules of uv, and the lock of a project."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import PurePath
from typing import Any

from dora_systemd.values import as_list, as_mapping

LOCK = "uv.lock"

Read = Callable[[str], bytes]
"""The content of a file by absolute path; raises OSError."""

_Workspace = Mapping[str, Any] | None
"""The table `tool.uv.workspace`; None if a pyproject.toml has none."""

_MOST_BYTES = 64 * 1024
"""Maximum bytes of a pyproject.toml: tomllib takes long for a large one with odd keys."""


def find_lock(places: Iterable[str], exists: Callable[[str], bool]) -> str:
    """Find the first of some directories that has a uv.lock; "" if none has."""
    return next((one for one in places if exists(f"{one}/{LOCK}")), "")


def uv_project(directory: str, read: Read) -> str | None:
    """The directory of .venv and uv.lock for `uv run` in `directory`, or None.

    It has the nearest pyproject.toml, or it is the workspace that has this project as a member.
    """
    projects = _projects(PurePath(directory), read)
    place, workspace = next(projects, (None, None))
    if place is None:
        return None
    if workspace is None:
        above, workspace = next(projects, (place, None))
        if _is_listed("members", place, above, workspace):
            is_excluded = _is_listed("exclude", place, above, workspace)
            place = place if is_excluded else above
    return str(place)


def _projects(directory: PurePath, read: Read) -> Iterator[tuple[PurePath, _Workspace]]:
    """Yield each directory with a pyproject.toml, from `directory` upwards."""
    for place in (directory, *directory.parents):
        try:
            data = read(str(place / "pyproject.toml"))
        except OSError:
            continue
        yield place, _parse(data)


def _parse(data: bytes) -> _Workspace:
    import tomllib

    try:
        table: Any = tomllib.loads(data.decode()) if len(data) <= _MOST_BYTES else None
    except (ValueError, RecursionError):
        table = None  # uv reports it
    for key in ("tool", "uv", "workspace"):
        table = as_mapping(table).get(key)
    return table if isinstance(table, dict) else None


def _is_listed(key: str, place: PurePath, above: PurePath, workspace: _Workspace) -> bool:
    """Whether a pattern of the workspace at `above` matches the project at `place`."""
    patterns = as_list((workspace or {}).get(key))
    texts = [one for one in patterns if isinstance(one, str)]
    # With a "/" in front, a pattern is for the whole path.
    project = PurePath("/", place.relative_to(above))
    return any(project.match(f"/{one}") for one in texts)
