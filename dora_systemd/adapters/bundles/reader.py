"""Reads a bundle that anybody may have written: bounded, and nothing is unpacked."""

import hashlib
import os
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dora_systemd.adapters.bundles.store import BLOCK
from dora_systemd.decisions.bundles.manifest import (
    MANIFEST,
    MOST_MANIFEST,
    MOST_PARTS,
    README,
    Manifest,
    is_part_name,
    no_bundle,
    parse_manifest,
)
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.trust.eyes import check_regular
from dora_systemd.trust.files import unreadable
from dora_systemd.values import shown

_FLAGS = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
_CHUNK = 1 << 20
MOST_TEXT = 32 * 1024 * 1024
"""Maximum bytes of a part that is read at once."""


class Bundle:
    """An open bundle. places: of each part its first byte and its size."""

    def __init__(self, path: Path, file: BinaryIO, places: dict[str, tuple[int, int]]) -> None:
        self._path, self._file, self._places = path, file, places
        self.manifest = self._read_manifest()

    def read(self, name: str) -> bytes:
        """A part, b"" if the bundle has none of that name. Raises DoraSystemdError (BAD_INPUT)."""
        begin, size = self._places.get(name, (0, 0))
        if size > MOST_TEXT:
            raise no_bundle(str(self._path), f"its {name} is too large")
        self._file.seek(begin)
        return self._file.read(size)

    def size_of(self, name: str) -> int:
        """Bytes of a part, 0 if the bundle has none of that name."""
        return self._places.get(name, (0, 0))[1]

    def read_at(self, name: str, at: int, size: int) -> bytes:
        """Bytes of a part from a place on; less comes at its end."""
        begin, whole = self._places.get(name, (0, 0))
        self._file.seek(begin + min(at, whole))
        return self._file.read(max(min(size, whole - at), 0))

    def check(self) -> None:
        """Compare all parts with the manifest. Raises DoraSystemdError (BAD_INPUT)."""
        known = {one.name: one for one in self.manifest.parts}
        if known.keys() != self._places.keys() - {MANIFEST}:
            raise self._changed("its files are not those of its manifest.json")
        for name, part in known.items():
            if self._digest(*self._places[name]) != part.digest:
                raise self._changed(f"{name} is not what was written")

    def _read_manifest(self) -> Manifest:
        if MANIFEST not in self._places:
            raise _was_cut(self._path, "it has no manifest.json")
        if self._places[MANIFEST][1] > MOST_MANIFEST:
            raise no_bundle(str(self._path), "its manifest.json is too large")
        return parse_manifest(self.read(MANIFEST), str(self._path))

    def _digest(self, begin: int, size: int) -> str:
        self._file.seek(begin)
        digest = hashlib.sha256()
        while size > 0 and (data := self._file.read(min(size, _CHUNK))):
            digest.update(data)
            size -= len(data)
        return digest.hexdigest()

    def _changed(self, reason: str) -> DoraSystemdError:
        message = f"cannot use {shown(str(self._path))}: it was changed: {reason}"
        return bad_input(message, "copy it again")


@contextmanager
def opened(path: Path) -> Iterator[Bundle]:
    """Open a bundle. Raises DoraSystemdError (BAD_INPUT) for a file that is none, or was cut."""
    try:
        with open(os.open(path, _FLAGS), "rb") as file:  # noqa: PTH123 - of a descriptor
            check_regular(os.fstat(file.fileno()).st_mode)
            yield Bundle(path, file, _places(path, file))
    except OSError as error:
        raise unreadable(path, error) from error


def chunks_of(path: Path) -> Iterator[bytes]:
    """The bytes of a file, in parts; it is opened when the first part is read. Raises OSError."""
    with open(os.open(path, _FLAGS | os.O_NOFOLLOW), "rb") as file:  # noqa: PTH123 - of a descriptor
        check_regular(os.fstat(file.fileno()).st_mode)
        while data := file.read(_CHUNK):
            yield data


def _places(path: Path, file: BinaryIO) -> dict[str, tuple[int, int]]:
    """Find the parts by their headers, without reading what is between these."""
    found: dict[str, tuple[int, int]] = {}
    size, at = os.fstat(file.fileno()).st_size, 0
    while True:
        file.seek(at)
        header = file.read(BLOCK)
        if found and header == bytes(BLOCK):
            return found
        name, length = _parsed(path, header, is_first=not found)
        if name in found or len(found) >= MOST_PARTS:
            raise no_bundle(str(path), f"it has {shown(name)} twice, or too many files")
        at += BLOCK
        if at + length > size:
            raise _was_cut(path, f"{name} is not complete")
        found[name] = (at, length)
        at += length + -length % BLOCK


def _parsed(path: Path, header: bytes, is_first: bool) -> tuple[str, int]:
    """The name and the size in a header."""
    if len(header) < BLOCK and not is_first:
        raise _was_cut(path, "its end is missing")
    try:
        info = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
    except (tarfile.HeaderError, ValueError) as error:
        raise no_bundle(str(path), "it is no tar file of doractl") from error
    is_ours = info.type == tarfile.REGTYPE and is_part_name(info.name)
    if not is_ours or info.size < 0 or (is_first and info.name != README):
        raise no_bundle(str(path), "it is a tar file of something else")
    return info.name, info.size


def _was_cut(path: Path, reason: str) -> DoraSystemdError:
    message = f"cannot read {shown(str(path))}: it was cut: {reason}"
    return bad_input(message, "copy it again")
