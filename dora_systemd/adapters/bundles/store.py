"""The bundles of one dataflow: NAME-TIME-EVENT.tar, in a directory that only its owner can enter.

In system scope all of it is root's, and no node can change or read it. A bundle is a tar file that
is written part by part, within a number of bytes.
"""

import errno
import fcntl
import json
import os
import re
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from dora_systemd.decisions.bundles.manifest import Part
from dora_systemd.decisions.views.rows import Bundles
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input, words_of
from dora_systemd.scope import place_hint
from dora_systemd.trust.paths import list_directory
from dora_systemd.values import SECOND, as_mapping, format_rounded_size, shown

BLOCK = 512
"""Bytes of a header, and what each file in a tar is filled up to."""
_END = bytes(2 * BLOCK)
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS)
"""Errors of the disk: no other part can be written either."""
PARTIAL = ".partial"
"""The end of the name of a bundle that is not complete."""
RESERVE = 64 * 1024
"""Bytes that the last parts need: the errors and the manifest."""


class Sink(Protocol):
    """Where a section writes, one piece after the other."""

    @property
    def left(self) -> int:
        """Bytes that the bundle has room for."""

    def write(self, data: bytes, /) -> int:
        """Write all of `data`. Raises DoraSystemdError if the bundle becomes too large."""


class Section(NamedTuple):
    """A part of a bundle that is to be written: its name, and what writes it.

    A section that raises an exception is left out, with a line in errors.txt.
    """

    name: str
    write: Callable[[Sink], object]


class _Bounded:
    """Counts what a section writes, and its digest."""

    def __init__(self, file: BinaryIO, most: int) -> None:
        import hashlib

        self._file, self._most = file, most
        self.size, self.digest = 0, hashlib.sha256()

    @property
    def left(self) -> int:
        return max(self._most - self.size, 0)

    def write(self, data: bytes, /) -> int:
        self.size += len(data)
        if self.size > self._most:
            raise DoraSystemdError(f"more than {self._most} bytes", "see size of black_box")
        self.digest.update(data)
        return self._file.write(data)


class Archive:
    """A bundle that is written next to `path`, of at most `most` bytes.

    Nobody but its owner can read it, from the first byte on. As a context manager it is complete
    after a block that raises nothing; otherwise nothing is left of it.
    """

    def __init__(self, path: Path, most: int, at_us: int) -> None:
        self.path, self._most, self._at_us = path, most, at_us
        # Not by the name of `path`, which can have as many bytes as a file system allows.
        self._partial = path.with_name(f".bundle.{os.urandom(8).hex()}{PARTIAL}")
        self.parts: list[Part] = []
        self.errors: list[str] = []

    def __enter__(self) -> "Archive":
        self._file = os.fdopen(os.open(self._partial, _NEW, 0o600), "w+b")
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            with self._file:
                if kind is None:
                    self._file.write(_END)
                    self._file.flush()
                    os.fsync(self._file.fileno())
            if kind is None:
                self._partial.rename(self.path)
                _sync(self.path.parent)
        finally:
            with suppress(OSError):
                self._partial.unlink()

    def add(self, section: Section, reserve: int = RESERVE) -> None:
        """Write a section; if that fails, take it back and record why. Raises OSError.

        reserve: bytes that must be left.
        """
        begin = self._file.tell()
        sink = _Bounded(self._file, max(self._most - begin - BLOCK - reserve, 0))
        try:
            if section.name in {one.name for one in self.parts}:  # a ring can have a number twice
                raise DoraSystemdError("there is one of that name")
            self._file.write(bytes(BLOCK))
            section.write(sink)
            self._file.write(bytes(-sink.size % BLOCK))
            self._file.flush()
            os.pwrite(self._file.fileno(), self._header(section.name, sink.size), begin)
        except Exception as error:  # one part must not cost the others, whatever its defect is
            if isinstance(error, OSError) and error.errno in _FULL:
                raise
            self._take_back(begin)
            self.errors.append(f"{section.name}: {_reason(error)}")
            return
        self.parts.append(Part(section.name, sink.size, sink.digest.hexdigest()))

    def _take_back(self, begin: int) -> None:
        self._file.seek(begin)
        self._file.truncate()

    def _header(self, name: str, size: int) -> bytes:
        import tarfile

        info = tarfile.TarInfo(name)
        info.size, info.mode, info.mtime = size, 0o600, self._at_us // 1_000_000
        return info.tobuf(tarfile.USTAR_FORMAT)


def _reason(error: Exception) -> str:
    if isinstance(error, DoraSystemdError):
        return error.message
    text = words_of(error)
    return text if isinstance(error, OSError) else f"{type(error).__name__}: {text}"


def _sync(directory: Path) -> None:
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


BUNDLES = "dora-systemd/bundles"
"""The directory of all bundles, below that of states."""
REQUESTED = "requested"
"""The EVENT of a bundle that was requested."""
_MOST_NAMES = 10_000
_ENDING = ".tar"
STAMP = "%Y%m%dT%H%M%SZ"
"""The form of the time in a name, for strftime(3)."""
_NAME = r"-([0-9]{8}T[0-9]{6}Z(?:\.[0-9]{1,3})?)-([a-z-]{1,40})\.tar"
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
        found = re.fullmatch(_NAME, rest)
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
            raise unusable(self.path, error, ", or -o FILE") from error

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

    All bytes, if the file system reports no size. Raises OSError, and DoraSystemdError if nearly
    none are left.
    """
    found = os.statvfs(directory)
    if not found.f_blocks:
        return sys.maxsize
    keep = min(found.f_blocks * found.f_frsize * _PERCENT // 100, _GIB)
    left = found.f_bavail * found.f_frsize - keep
    if left < LEAST:
        free = format_rounded_size(found.f_bavail * found.f_frsize)
        message = f"cannot write a bundle to {shown(str(directory))}: only {free} of the disk free"
        raise DoraSystemdError(message, f"a bundle leaves {format_rounded_size(keep)} free; see df")
    return left


_PLACE_HINTS = {
    errno.ENOENT: "create that directory first, or name a file in another one",
    errno.ENOTDIR: "name a file in a directory",
    errno.ENAMETOOLONG: "name a file with a shorter name",
}


def unwritable(path: Path, error: OSError) -> DoraSystemdError:
    """The error for a place where no bundle can be written."""
    message = f"cannot write a bundle to {shown(str(path))}: {error.strerror}"
    elsewhere = "-o FILE in a directory of your own"
    if isinstance(error, PermissionError):
        hint = elsewhere if os.geteuid() == 0 else f"use sudo, or {elsewhere}"
        return DoraSystemdError(message, hint, ExitCode.NO_PERMISSION)
    if hint := _PLACE_HINTS.get(error.errno or 0, ""):
        return bad_input(message, hint)
    return DoraSystemdError(message, elsewhere if error.errno == errno.EROFS else "see df")


def require_replaceable(path: Path) -> None:
    """Raise DoraSystemdError (BAD_INPUT) unless a bundle may take the place of what is at `path`.

    A bundle is renamed to its path: root would replace /dev/null or /dev/stdout by a file, and
    nothing that needs the device would work any more.
    """
    with suppress(OSError):  # there is nothing, or the write fails
        mode = path.lstat().st_mode
        if not stat.S_ISREG(mode):
            is_directory = stat.S_ISDIR(mode)
            reason = "it is a directory" if is_directory else "it is not a regular file"
            hint = "name a file in it" if is_directory else "name another file"
            raise bad_input(f"cannot write a bundle to {shown(str(path))}: {reason}", hint)


def unusable(path: Path, error: OSError, otherwise: str = "") -> DoraSystemdError:
    """The error for a store that cannot be used. otherwise: what else the hint names if refused."""
    is_refused = isinstance(error, PermissionError)
    hint = place_hint(path, error) + (otherwise if is_refused else "")
    code = ExitCode.NO_PERMISSION if is_refused else ExitCode.FAILURE
    return DoraSystemdError(f"cannot use {shown(str(path))}: {error.strerror}", hint, code)
