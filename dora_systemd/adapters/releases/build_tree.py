"""The tree in which a release is built: a copy of the project that the nodes' user may change.

The directory above it is root's alone, so nobody reaches the tree by a path but the unit of the
build, which sees it where the release will be. Its files are no hard links: the inodes of other
releases would become that user's. All of it is hostile from the moment it is handed over.
"""

import os
from collections.abc import Mapping
from pathlib import Path

from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.entries import Stored

_LEAST_SHARE = 20
"""The build has to leave one part in so many of the file system free."""


class BuildTree(Draft):
    """A tree in `store`. All methods raise OSError."""

    def __init__(self, store: Store) -> None:
        super().__init__(store, "build")
        self._least = tuple(
            min(total // _LEAST_SHARE, free // 2) for total, free in _room(self._tree)
        )

    def hand_over(self, files: Mapping[str, Stored], owner: tuple[int, int] | None) -> None:
        """Let the nodes' user write all of it.

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
