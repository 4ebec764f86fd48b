"""A release that is being written: it gets its name by a rename, when all data is on the disk.

Everything is created below a directory that only its writer can change, so no path in it can lead
elsewhere. Files that are equal to those of the last release become hard links to them.
"""

import contextlib
import ctypes
import errno
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.adapters.releases.store import (
    MANIFEST,
    Store,
    read_by_threads,
    remove_tree,
    stored_at,
    write_part,
)
from dora_systemd.decisions.releases.manifest import Manifest, Stored, format_manifest
from dora_systemd.names import TREE
from dora_systemd.trust.paths import sync_directory

if TYPE_CHECKING:
    from dora_systemd.adapters.releases.store import Read

_CHUNK = 256 * 1024
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_LIBC = ctypes.CDLL(None, use_errno=True)
_LEAST_SHARE = 20
"""The build has to leave one part in so many of the file system free."""


class Draft:
    """A release of `store` without a name yet. All methods raise OSError.

    kind: part of the directory's name. damaged: the files of another release that could not be
    shared, because they differ from that release's manifest.
    """

    def __init__(self, store: Store, kind: str = "new") -> None:
        self._store = store
        self._path = store.path / f".{kind}-{os.urandom(6).hex()}"
        self._tree = self._path / TREE
        self._made = {self._tree}
        self._ahead: dict[str, Read] = {}
        self.damaged: list[str] = []
        self._path.mkdir(0o700)  # others may not read what it gets
        try:
            self._tree.mkdir()
        except OSError:  # no room
            self.discard()
            raise

    @property
    def tree(self) -> Path:
        """The directory of its files."""
        return self._tree

    def write(self, path: str, chunks: Iterable[bytes], is_executable: bool) -> Stored:
        mode = 0o555 if is_executable else 0o444
        digest, size = hashlib.sha256(), 0
        # Not without a buffer: on a full disk write(2) may take a part, and raise nothing.
        with os.fdopen(os.open(self._place(path), _NEW, 0o600), "wb") as file:
            for chunk in chunks:
                digest.update(chunk)
                size += len(chunk)
                file.write(chunk)
            os.fchmod(file.fileno(), mode)
        return Stored(size, is_executable, digest.hexdigest())

    def share(self, path: str, release_id: str, stored: Stored) -> bool:
        """Share a file with the same path in another release, where it was `stored`.

        False if the content differs from `stored`, as on a bad disk: sharing would copy the damage
        from release to release, and no later deploy would repair it.
        """
        file = self._store.tree(release_id) / path
        ahead = self._ahead.get(path)
        is_intact = (ahead.result() if ahead else stored_at(file)) == stored
        if is_intact:
            self.adopt(path, file)
        else:
            self.damaged.append(path)
        return is_intact

    @contextlib.contextmanager
    def reading_ahead(self, release_id: str, paths: Iterable[str]) -> Iterator[None]:
        """In the context, threads read the files that share() will compare."""
        with read_by_threads(self._store.tree(release_id), paths) as self._ahead:
            yield

    def adopt(self, path: str, file: Path) -> None:
        """Share a file of another tree, which must be read-only, by a hard link."""
        self._place(path).hardlink_to(file)

    def copy(self, path: str, file: Path, is_executable: bool) -> Stored:
        """Copy a file of another tree, which must not change meanwhile."""
        with file.open("rb") as opened:
            chunks = iter(lambda: opened.read(_CHUNK), b"")
            return self.write(path, chunks, is_executable)

    def link(self, path: str, target: str) -> Stored:
        self._place(path).symlink_to(target)
        return Stored(target=target)

    def publish(self, manifest: Manifest, group: int | None) -> None:
        """Write all data to the disk, and give the release its name.

        group: may enter the release besides its owner; None: no other user may.
        """
        write_part(self._path, MANIFEST, format_manifest(manifest))
        self.lend(group)
        _sync_file_system(self._path)
        self._path.rename(self._store.release(manifest.id))
        sync_directory(self._store.path)

    def lend(self, group: int | None) -> None:
        """Make the tree read-only, and let a group read it; None: only its owner."""
        for directory in self._made:
            directory.chmod(0o555)
        if group is not None:
            os.chown(self._path, -1, group)
            self._path.chmod(0o750)

    def discard(self) -> None:
        """Delete the draft, unless it has been published."""
        remove_tree(self._path)

    def free_bytes(self) -> int:
        """The space on its file system."""
        found = os.statvfs(self._path)
        return found.f_bavail * found.f_frsize

    def require_space(self, size: int) -> None:
        """Raise OSError (ENOSPC) unless it has room for `size` bytes."""
        if size > self.free_bytes():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _place(self, path: str) -> Path:
        place = self._tree / path
        missing = []
        for directory in place.parents:
            if directory in self._made:
                break
            missing.append(directory)
        for directory in reversed(missing):
            directory.mkdir(0o755)
            self._made.add(directory)
        return place


def _sync_file_system(path: Path) -> None:
    """See syncfs(2): thousands of fsync(2) would take minutes on an SD card."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if _LIBC.syncfs(fd):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    finally:
        os.close(fd)


class BuildTree(Draft):
    """The tree in which a release is built: a copy of the project that the nodes' user may change.

    The directory above the tree is root's alone, so only the unit of the build reaches the tree by
    a path, the final path of the release. The files are no hard links: else inodes of other
    releases would become that user's. After hand_over() nothing in the tree can be trusted. All
    methods raise OSError.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store, "build")
        self._least = tuple(
            min(total // _LEAST_SHARE, free // 2) for total, free in _room(self._tree)
        )

    def hand_over(self, files: Mapping[str, Stored], owner: tuple[int, int] | None) -> None:
        """Let the nodes' user write the whole tree.

        files: that were copied. owner: uid and gid of that user, None for the caller.
        """
        for path, one in files.items():
            if not one.target:
                (self._tree / path).chmod(0o755 if one.is_executable else 0o644)
        for place in (*(self._tree / path for path in files), *self._made):
            if owner is not None:
                os.chown(place, *owner, follow_symlinks=False)
        self._tree.chmod(0o700)

    def is_disk_full(self) -> bool:
        """Whether the build has taken more of the file system than it may."""
        return any(
            free < least for (_, free), least in zip(_room(self._path), self._least, strict=True)
        )


def _room(path: Path) -> list[tuple[int, int]]:
    """The bytes and the inodes of a file system: all, and those that are free."""
    found = os.statvfs(path)
    bytes_ = (found.f_blocks * found.f_frsize, found.f_bavail * found.f_frsize)
    return [bytes_, (found.f_files, found.f_favail)]
