"""A project on its way to other hosts: the copy that all of them get, and what one receives.

Hosts get the copy one after the other, and all get the same bytes.
"""

import contextlib
import fcntl
import hashlib
import os
import select
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store, make_directories, remove_tree, unusable
from dora_systemd.decisions.releases.manifest import Stored
from dora_systemd.errors import DoraSystemdError

_DIRECTORY = "/var/tmp"
"""A directory that unlike /tmp is on a disk."""
_NAME = ".sent"
"""No dataflow has such a name."""
_YOUNG_SECONDS = 60.0
_RACES = 20
"""Attempts: another process that has ended may remove the shared directory at the same time."""
_CHUNK = 256 * 1024


class Spool:
    """The contents of files, in one file without a name, below `directory`.

    All methods raise DoraSystemdError if the directory cannot be used.
    """

    def __init__(self, fd: int, directory: Path) -> None:
        self._fd, self._directory = fd, directory
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
        with _usable(self._directory):
            while done < len(chunk):
                done += os.pwrite(self._fd, chunk[done:], at + done)
        return done

    def share(self, path: str, release_id: str, stored: Stored) -> bool:
        """There is no other release."""
        del path, release_id, stored
        return False

    def link(self, path: str, target: str) -> Stored:
        """Return the entry of a symbolic link, which has no content."""
        del path
        return Stored(target=target)

    def read(self, one: Stored) -> Iterator[bytes]:
        at = self._places[one.digest]
        end = at + one.size
        while at < end and (chunk := self._get(min(_CHUNK, end - at), at)):
            at += len(chunk)
            yield chunk

    def _get(self, size: int, at: int) -> bytes:
        with _usable(self._directory):
            return os.pread(self._fd, size, at)


@contextlib.contextmanager
def spooled() -> Iterator[Spool]:
    """A spool until the end of the block. Raises DoraSystemdError if there is no space for it."""
    directory = Path(os.environ.get("TMPDIR") or _DIRECTORY)
    with contextlib.ExitStack() as opened:
        with _usable(directory):
            file = opened.enter_context(tempfile.TemporaryFile(dir=directory))
        yield Spool(file.fileno(), directory)


@contextlib.contextmanager
def _usable(directory: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unusable(directory, error) from error


class Stream:
    """The bytes of a file descriptor. All methods raise DoraSystemdError at an early end.

    seconds: timeout for more bytes: the sender may be stopped, or gone without a notice.
    """

    def __init__(self, fd: int, seconds: float = 90.0) -> None:
        self._fd = fd
        self._seconds = seconds
        self._held = b""

    def line(self, most: int) -> bytes:
        """A line without its end, of at most `most` bytes."""
        parts, size = [], 0
        while True:
            line, end, rest = (self._held or self._more()).partition(b"\n")
            size += len(line)
            if size > most:
                raise _broken("its first line is too long")
            parts.append(line)
            self._held = rest
            if end:
                return b"".join(parts)

    def chunks(self, size: int) -> Iterator[bytes]:
        """The next `size` bytes."""
        while size:
            data = self._held or self._more()
            data, self._held = data[:size], data[size:]
            size -= len(data)
            yield data

    def wait_for_end(self, other: int) -> bool:
        """Wait until the sender has ended; False if `other`, a pipe, has something before that."""
        with contextlib.suppress(OSError):
            while other not in select.select([self._fd, other], [], [])[0]:
                if not os.read(self._fd, _CHUNK):
                    return True
            return False
        return True

    def _more(self) -> bytes:
        if not select.select([self._fd], [], [], self._seconds)[0]:
            raise _broken(f"no more of it came for {self._seconds:g}s")
        if not (data := os.read(self._fd, _CHUNK)):
            raise _broken("it ended too early")
        return data


def _broken(reason: str) -> DoraSystemdError:
    message = f"cannot read a project from standard input: {reason}"
    return DoraSystemdError(message, "nothing has changed; deploy again")


@contextlib.contextmanager
def incoming(root: Path) -> Iterator[Draft]:
    """A place below `root` for files that are sent, until the end of the block. Raises OSError."""
    store = Store(root, _NAME)
    draft = _begun(store)
    try:
        with _locked(draft.tree.parent):
            yield draft
    finally:
        draft.discard()
        with contextlib.suppress(OSError):
            store.path.rmdir()


def _begun(store: Store) -> Draft:
    """A draft in the directory that all senders share. Raises OSError."""
    for _ in range(_RACES):
        # Another process may remove the directory just before this draft is created in it.
        with contextlib.suppress(FileNotFoundError):
            return _begin(store)
    return _begin(store)


def _begin(store: Store) -> Draft:
    make_directories(store.path.parent)
    with contextlib.suppress(FileExistsError):
        store.path.mkdir(0o711)
    store.path.chmod(0o711)  # users who may not read it cannot lock what is in it
    _clean(store)
    return Draft(store)


def leftovers(root: Path) -> list[Path]:
    """Find what a killed doractl has left in the shared directory."""
    return [path for path in Store(root, _NAME).unfinished() if not _is_used(path)]


def _clean(store: Store) -> None:
    for path in leftovers(store.path.parent):
        remove_tree(path)


def _is_used(path: Path) -> bool:
    """Whether a process writes to it, or may be about to lock it."""
    try:
        if abs(time.time() - path.stat().st_mtime) < _YOUNG_SECONDS:
            return True
        with _locked(path):
            return False
    except OSError:
        return True


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock on a directory; the kernel ends it with the process. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(fd)
