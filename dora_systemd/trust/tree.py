"""Directories that others may change: what of one they can, and what root removes from it.

Root works in a directory by path, as rsync(1) does, only if nobody else can change it.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NoReturn

from dora_systemd.trust.paths import firm_part, user_name
from dora_systemd.values import shown

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
"""A group counts as others, see firm_part()."""
_MOST_FILES = 100


def strange_part(directory: str | Path) -> str:
    """Find what others than root can change in a directory or on the way to it, and why; or "".

    A directory that does not exist is one that root makes: then the way to it is all.
    """
    path = Path(os.path.normpath(directory))
    try:
        firm = Path(firm_part(path))
        if firm != path:
            return _strange_way(path, firm)
        # root owns all directories of the path, so nobody else can change what it leads to.
        return next(_strange(path.resolve()), "")
    except OSError as error:
        return f"cannot read {shown(str(error.filename or path))}: {error.strerror}"


def _strange_way(path: Path, firm: Path) -> str:
    following = firm / path.relative_to(firm).parts[0]
    if not os.path.lexists(following) and not _reason(firm.stat()):
        return ""
    return f"others than root can replace {shown(str(following))}"


def _strange(path: Path) -> Iterator[str]:
    """The walk follows no link, and goes into no directory before that has passed."""
    for where, directories, files, opened in os.fwalk(path, onerror=_raise):
        for name in (".", *directories, *files):
            status = os.stat(name, dir_fd=opened, follow_symlinks=False)
            if reason := _reason(status):
                yield f"{shown(str(Path(where, name)))} {reason}"


def _raise(error: OSError) -> NoReturn:
    raise error


def _reason(status: os.stat_result) -> str:
    if status.st_uid:
        return f"belongs to {user_name(status.st_uid)}"
    is_shared = stat.S_ISDIR(status.st_mode) and status.st_mode & _OTHERS
    return "can be changed by others than root" if is_shared else ""


def clear_directory(directory: Path) -> bool:
    """Remove the files in a directory of another user; return whether nothing is left.

    No link is followed. A directory in it stays: a tree could keep root busy for a long time.
    """
    try:
        place = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return True  # the dataflow has ended
    try:
        for name in _some_names(place):
            with suppress(OSError):
                os.unlink(name, dir_fd=place)
        return not _some_names(place)
    except OSError:
        return False
    finally:
        os.close(place)


def _some_names(place: int) -> list[str]:
    with os.scandir(place) as entries:
        return [one.name for one in islice(entries, _MOST_FILES)]
