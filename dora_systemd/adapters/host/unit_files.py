"""Reads and writes unit files; after a power failure either the old or the new one exists."""

import contextlib
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.files import REFUSED, read_text, write_atomic
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import place_hint
from dora_systemd.trust.paths import sync_directory

_WRITTEN_SECONDS = 60.0
"""A younger one may still be written."""
_RANDOM = "[0-9a-f]" * 8
"""The end of the name of a temporary file, see write_atomic()."""


def read_unit_file(path: Path) -> str | None:
    """Read `path`; None if it does not exist.

    Raises DoraSystemdError: NAME_IN_USE for a link (as by systemctl mask) or anything that is not a
    regular file, BAD_INPUT for an unreadable file.
    """
    mode = None
    with _told("read", path), contextlib.suppress(FileNotFoundError):
        mode = path.lstat().st_mode
    if mode is None:
        return None
    if not stat.S_ISREG(mode):
        raise foreign_file(path)
    return read_text(path)


def written_us(path: Path) -> int:
    """Return when a unit file was written, CLOCK_REALTIME µs; 0 if there is none."""
    try:
        return path.lstat().st_mtime_ns // 1000
    except OSError:
        return 0


def write_link(path: Path, target: str) -> None:
    """Create the symbolic link `path` unless it exists. Raises DoraSystemdError."""
    with _told("write", path):
        _make_parents(path)
        if not path.is_symlink():
            path.symlink_to(target)


def _make_parents(path: Path) -> list[Path]:
    """Create the missing directories of `path`, which all may read whatever the umask is."""
    made = [one for one in path.parents if not one.exists()]
    for directory in reversed(made):
        directory.mkdir(0o755, exist_ok=True)
        directory.chmod(0o755)
    return made


def remove_empty(directory: Path) -> None:
    """Remove a directory if it is empty."""
    with contextlib.suppress(OSError):
        directory.rmdir()


def write_unit_file(path: Path, text: str) -> None:
    """Write `text` to `path` and sync it to the disk; creates missing directories.

    Raises DoraSystemdError; then `path` is unchanged, unless the disk is broken.
    """
    with _told("write", path):
        made = _make_parents(path)
        write_atomic(path, text, is_durable=True)
        # The content is on the disk by now; syncing the directories makes the names durable.
        for directory in (path.parent, *(one.parent for one in made)):
            sync_directory(directory)


def remains_of(path: Path) -> list[Path]:
    """Find what a process left that was killed while writing this unit file, see write_atomic()."""
    found = []
    # Not .NAME.swp: an editor's file has unsaved work of a person.
    for one in path.parent.glob(f".{path.name}.{_RANDOM}"):
        with contextlib.suppress(FileNotFoundError):  # it has just got its name
            status = one.lstat()
            is_old = not 0 <= time.time() - status.st_mtime < _WRITTEN_SECONDS
            found += [one] if stat.S_ISREG(status.st_mode) and is_old else []
    return sorted(found)


def sync_links(path: Path) -> None:
    """Make the links by which targets start a unit file durable, which systemd does not.

    Raises DoraSystemdError.
    """
    with _told("write", path):
        for link in path.parent.glob(f"*/{path.name}"):
            sync_directory(link.parent)
        sync_directory(path.parent)


def remove_unit_file(path: Path) -> None:
    """Remove `path` if it exists. Raises DoraSystemdError."""
    with _told("remove", path):
        path.unlink(missing_ok=True)


def put_unit_file(path: Path, text: str | None) -> None:
    """Write `text` to `path`, or remove it for None. Raises DoraSystemdError."""
    if text is None:
        remove_unit_file(path)
    else:
        write_unit_file(path, text)


SET_FILE = "60-set.conf"
_CHANGES = ("50-*.conf", SET_FILE)
"""systemd's own drop-ins for changed properties, and ours for what only the runner knows."""


def drop_in_directory(fragment: Path, is_transient: bool) -> Path:
    """The directory of drop-ins for changes: those of a transient unit disappear with it."""
    place = fragment.parent
    if not is_transient and place.suffix != ".control":  # as of a release on trial
        place = place.with_name(f"{place.name}.control")
    return place / f"{fragment.name}.d"


def changed_files(fragment: Path) -> list[Path]:
    """The drop-ins by which `doractl set` or systemctl set-property have changed a unit file."""
    place = drop_in_directory(fragment, is_transient=False)
    return sorted(path for pattern in _CHANGES for path in place.glob(pattern))


def remove_changes(fragment: Path) -> None:
    """Remove the drop-ins of changes. Raises DoraSystemdError."""
    for path in changed_files(fragment):
        remove_unit_file(path)
    remove_empty(drop_in_directory(fragment, is_transient=False))  # may have other drop-ins


def foreign_file(path: Path) -> DoraSystemdError:
    """The error for a foreign file at one of our paths."""
    return DoraSystemdError(
        f"cannot use {path}: it already exists and is not doractl's",
        "look at it; then move it away, or take another name",
        ExitCode.NAME_IN_USE,
    )


@contextlib.contextmanager
def _told(what: str, path: Path) -> Iterator[None]:
    """Turn OSError into DoraSystemdError "cannot `what` `path`"."""
    try:
        yield
    except OSError as error:
        is_refused = error.errno in REFUSED
        hint = place_hint(path, error) if is_refused else ""
        code = ExitCode.NO_PERMISSION if is_refused else ExitCode.FAILURE
        raise DoraSystemdError(f"cannot {what} {path}: {error.strerror}", hint, code) from error
