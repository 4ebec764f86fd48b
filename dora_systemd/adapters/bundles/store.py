"""The bundles of one dataflow: NAME-TIME-EVENT.tar, in a directory that only its owner can enter.

In system scope all of it is root's, and no node can change or read it.
"""

import fcntl
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bundles.archive import PARTIAL
from dora_systemd.decisions.views.rows import Bundles
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import SECOND, as_mapping, format_rounded_size, shown

BUNDLES = "dora-systemd/bundles"
"""The directory of all bundles, below that of states."""
REQUESTED = "requested"
"""The EVENT of a bundle that was requested."""
_MOST_NAMES = 10_000
_ENDING = ".tar"
STAMP = "%Y%m%dT%H%M%SZ"
"""The form of the time in a name, for strftime(3)."""
_NAME = re.compile(r"-([0-9]{8}T[0-9]{6}Z(?:\.[0-9]{1,3})?)-([a-z-]{1,40})\.tar")
_GIB, _PERCENT = 1 << 30, 15
_REFUSED = ".refused"
"""The file that counts the bundles that were not written."""
_MOST_TEXT = 4096
LEAST = 1 << 20
"""Bytes below which a bundle would have nothing in it."""


class Stored(NamedTuple):
    """A bundle in the store."""

    path: Path
    stamp: str  # when it was written, such as 20261127T041500Z
    event: str  # what failed, see ORDER in decisions/notice/happened.py, or REQUESTED
    size: int

    @property
    def place(self) -> tuple[str, int]:
        """What sorts bundles: the time, and the number of several within a second."""
        return self.stamp[:16], int(self.stamp[17:] or 0)

    @property
    def at_us(self) -> int:
        """The time of `stamp`, CLOCK_REALTIME; 0 if there is no such time."""
        with suppress(ValueError):
            moment = datetime.strptime(self.stamp[:16], STAMP).replace(tzinfo=UTC)
            return int(moment.timestamp()) * SECOND
        return 0

    @property
    def id(self) -> str:
        """The name of its file."""
        return self.path.name


class BundleStore:
    """The bundles of the dataflow `name`. state_root: that of the scope."""

    def __init__(self, state_root: Path, name: str) -> None:
        self.name = name
        self.root = state_root / BUNDLES
        self.path = self.root / name

    def known(self) -> list[Stored]:
        """Return all bundles, oldest first. Raises DoraSystemdError (NO_PERMISSION)."""
        try:
            names = list_directory(self.path, _MOST_NAMES)
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise unusable(self.path, error) from error
        return sorted(filter(None, map(self._stored, names)), key=lambda one: one.place)

    def _stored(self, name: str) -> Stored | None:
        begin, rest = name[: len(self.name)], name[len(self.name) :]
        found = _NAME.fullmatch(rest)
        if begin != self.name or not found:
            return None
        try:
            return Stored(self.path / name, found[1], found[2], (self.path / name).stat().st_size)
        except OSError:
            return None

    def of_failures(self) -> Bundles:
        """What failures have left. Raises DoraSystemdError (NO_PERMISSION)."""
        found = [one for one in self.known() if one.event != REQUESTED]
        refused = self._refused()
        if not found:
            return refused
        newest = found[-1]
        return refused._replace(kept=len(found), newest=str(newest.path), newest_at=newest.at_us)

    def _refused(self) -> Bundles:
        with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
            data = (self.path / _REFUSED).read_bytes()[:_MOST_TEXT]
            found = as_mapping(json.loads(data))
            return Bundles(0, "", 0, int(found["count"]), int(found["at_us"]), str(found["reason"]))
        return Bundles()

    def add_refused(self, reason: str, at_us: int) -> None:
        """Count a bundle that was not written; call it with the lock. Raises OSError."""
        facts = {"count": self._refused().refused + 1, "at_us": at_us, "reason": reason}
        place = self.path / f"{_REFUSED}{PARTIAL}"
        place.write_text(json.dumps(facts))
        place.replace(self.path / _REFUSED)

    def new_path(self, stamp: str, event: str) -> Path:
        """A path behind all of the same second. stamp: of the time."""
        same = [one.place[1] for one in self.known() if one.place[0] == stamp]
        number = f".{max(same) + 1}" if same else ""
        return self.path / f"{self.name}-{stamp}{number}-{event}{_ENDING}"

    def make(self) -> None:
        """Create the directory. Raises DoraSystemdError."""
        try:
            for one, mode in ((self.root.parent, 0o755), (self.root, 0o700), (self.path, 0o700)):
                if not one.exists():
                    one.mkdir(mode, parents=True, exist_ok=True)
                    one.chmod(mode)
        except OSError as error:
            raise unusable(self.path, error) from error

    def remove(self, names: list[str]) -> None:
        """Remove bundles, or none of them. Raises DoraSystemdError (NOT_FOUND)."""
        known = {one.id for one in self.known()}
        for name in names:
            if name not in known:
                hint = f"doractl bundles {self.name} lists all"
                message = f"{self.name} has no bundle {shown(name)}"
                raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND)
        self.drop(names)
        if known == {*names}:
            (self.path / _REFUSED).unlink(missing_ok=True)
            with suppress(OSError):  # there is another file
                self.path.rmdir()

    def drop(self, names: list[str]) -> None:
        """Remove these bundles, which are known; the directory stays."""
        for name in names:
            with suppress(FileNotFoundError):
                (self.path / name).unlink()

    def remove_partial(self) -> None:
        """Remove what a writer that was killed has left; call it with the lock."""
        for path in self.path.glob(f"*{PARTIAL}"):
            with suppress(OSError):
                path.unlink()


@contextmanager
def locked(store: BundleStore) -> Iterator[None]:
    """Let one process at a time write to the store; the kernel ends the lock with the process."""
    store.make()
    try:
        fd = os.open(store.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        raise unusable(store.path, error) from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def room(directory: Path) -> int:
    """Bytes that a bundle may take: the disk keeps 15 %, or 1 GiB if that is less.

    Raises DoraSystemdError if that is nearly nothing.
    """
    try:
        found = os.statvfs(directory)
    except OSError as error:
        raise unusable(directory, error) from error
    keep = min(found.f_blocks * found.f_frsize * _PERCENT // 100, _GIB)
    left = found.f_bavail * found.f_frsize - keep
    if left < LEAST:
        free = format_rounded_size(found.f_bavail * found.f_frsize)
        message = f"cannot write a bundle to {shown(str(directory))}: only {free} of the disk free"
        raise DoraSystemdError(message, f"a bundle leaves {format_rounded_size(keep)} free; see df")
    return left


def unusable(path: Path, error: OSError) -> DoraSystemdError:
    """The error for a store that cannot be used."""
    is_refused = isinstance(error, PermissionError)
    hint = "use sudo, or -o FILE" if is_refused else "see df"
    code = ExitCode.NO_PERMISSION if is_refused else ExitCode.FAILURE
    return DoraSystemdError(f"cannot use {shown(str(path))}: {error.strerror}", hint, code)
