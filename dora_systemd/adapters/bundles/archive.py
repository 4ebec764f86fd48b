"""Writes a bundle: a tar file, part by part, within a number of bytes."""

import errno
import hashlib
import os
import tarfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from dora_systemd.decisions.bundles.manifest import Part
from dora_systemd.errors import DoraSystemdError, words_of

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
        self._partial = path.with_name(f".{path.name}.{os.urandom(4).hex()}{PARTIAL}")
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
            self._file.write(bytes(BLOCK))
            section.write(sink)
            self._file.write(bytes(-sink.size % BLOCK))
            self._file.flush()
        except Exception as error:  # one part must not cost the others, whatever its defect is
            if isinstance(error, OSError) and error.errno in _FULL:
                raise
            self._take_back(begin)
            self.errors.append(f"{section.name}: {_reason(error)}")
            return
        os.pwrite(self._file.fileno(), self._header(section.name, sink.size), begin)
        self.parts.append(Part(section.name, sink.size, sink.digest.hexdigest()))

    def _take_back(self, begin: int) -> None:
        self._file.seek(begin)
        self._file.truncate()

    def _header(self, name: str, size: int) -> bytes:
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
