"""A copy of a project for hosts that get it one after the other: all get the same bytes."""

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from dora_systemd.adapters.releases.store import unusable
from dora_systemd.decisions.releases.entries import Stored

_CHUNK = 256 * 1024
_DIRECTORY = "/var/tmp"
"""Unlike /tmp, it is on a disk."""


class Spool:
    """The contents of files, in one file without a name. All methods raise OSError."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._places: dict[str, int] = {}
        self._end = 0

    def write(self, path: str, chunks: Iterable[bytes], is_executable: bool) -> Stored:
        """Keep the content of a file, once."""
        del path
        digest, at = hashlib.sha256(), self._end
        for chunk in chunks:
            digest.update(chunk)
            at += self._put(chunk, at)
        name, size = digest.hexdigest(), at - self._end
        if self._places.setdefault(name, self._end) == self._end:
            self._end = at
        return Stored(size, is_executable, name)

    def _put(self, chunk: bytes, at: int) -> int:
        done = 0
        while done < len(chunk):
            done += os.pwrite(self._fd, chunk[done:], at + done)
        return done

    def share(self, path: str, release_id: str, stored: Stored) -> bool:
        """There is no other release."""
        del path, release_id, stored
        return False

    def link(self, path: str, target: str) -> Stored:
        """A symbolic link has no content."""
        del path
        return Stored(target=target)

    def read(self, one: Stored) -> Iterator[bytes]:
        """The content of a file."""
        at = self._places[one.digest]
        end = at + one.size
        while at < end and (chunk := os.pread(self._fd, min(_CHUNK, end - at), at)):
            at += len(chunk)
            yield chunk


@contextlib.contextmanager
def spooled() -> Iterator[Spool]:
    """A spool until the end of the block. Raises DoraSystemdError if there is no space for it."""
    directory = Path(os.environ.get("TMPDIR") or _DIRECTORY)
    try:
        with tempfile.TemporaryFile(dir=directory) as file:
            yield Spool(file.fileno())
    except OSError as error:
        raise unusable(directory, error) from error
