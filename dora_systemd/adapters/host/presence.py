"""Checks paths that nodes need: whether they exist, and which directories to watch.

The runner checks with the rights and the view of its nodes, so a node learns nothing new from it.
"""

import contextlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

_MOST_LINKS = 40


class Presence(NamedTuple):
    """The state of a path.

    A device that was unplugged and plugged in between two looks has another identity.
    """

    reason: str = ""  # why it cannot be used, or ""
    identity: tuple[int, ...] | None = None  # of a device or an interface


def look_at(path: str) -> Presence:
    """Check what is at `path`, behind links."""
    try:
        found = Path(path).stat()
    except PermissionError:
        return Presence("no permission to look there")
    except OSError:
        return Presence("not there")
    # udev sets owner and group of a device after the kernel has made it.
    if not os.access(path, os.R_OK):
        return Presence("no permission to read it")
    is_device = stat.S_ISCHR(found.st_mode) or stat.S_ISBLK(found.st_mode)
    return Presence("", (found.st_dev, found.st_ino, found.st_rdev) if is_device else None)


def watched_places(paths: Iterable[str]) -> set[str]:
    """Return the directories in which one of `paths` can appear or disappear.

    These are the nearest existing directories of each path and of the links on the way to it.
    """
    return {place for path in paths for place in _places(path)}


def _places(path: str) -> set[str]:
    found: set[str] = set()
    for _ in range(_MOST_LINKS):
        found |= _existing(path)
        link = _first_link(path)
        if link is None:
            break
        path = link
    return found


def _existing(path: str) -> set[str]:
    """Return the nearest existing directory above `path`, and the parent of that directory.

    A watch on the parent notices when the directory is moved away.
    """
    parent = next(one for one in Path(path).parents if _is_directory(one) or one == one.parent)
    return {str(parent), str(parent.parent)}


def _is_directory(path: Path) -> bool:
    """Whether `path` is a directory; False also without permission to find out."""
    return os.path.isdir(path)  # noqa: PTH112 - up to Python 3.13, is_dir() raises for EACCES


def _first_link(path: str) -> str | None:
    """The path behind the first link in it, or None without one."""
    for place in [*reversed(Path(path).parents), Path(path)]:
        with contextlib.suppress(OSError):
            behind = place.parent / place.readlink() / Path(path).relative_to(place)
            return os.path.normpath(behind)
    return None
