"""Paths that others may own: walked by descriptor, read within bounds, their owner never guessed.

The rules are those of systemd's own chase() with CHASE_SAFE:

- A path is walked by descriptor, component by component. A symbolic link is followed only where
  root alone can replace it.
- Whoever owns a directory decides what is in it. So below a directory that is not root's, only
  things of the same owner count as theirs; anything else was borrowed.
- The owner is the owner of the descriptor that is read, never that of a path.
- A read is bounded, and of a regular file. Nothing that a path can be makes it hang.

A caller that is not root has no more rights than the files give: for it nothing is refused here.
"""

import contextlib
import errno
import grp
import os
import pwd
import stat
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import shown

_MAX_LINKS = 40
_STEP = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
_OTHERS_WRITE = stat.S_IWOTH


class Place(NamedTuple):
    """Where a walk has arrived.

    uid: owner of the thing. owners: of it and of all directories above it. shared: a directory
    on the way, or at its end, whose entries more accounts than its owner can replace, or "".
    """

    path: str
    uid: int
    mode: int
    owners: frozenset[int]
    shared: str = ""

    @property
    def is_roots(self) -> bool:
        """Whether nobody but root can change it or put something else in its place."""
        others_write = self.mode & (stat.S_IWOTH | stat.S_IWGRP)
        return self.owners == {0} and not self.shared and not others_write

    @property
    def is_open(self) -> bool:
        """Whether anybody can put something into it, as into /tmp."""
        return stat.S_ISDIR(self.mode) and bool(self.mode & _OTHERS_WRITE)

    @property
    def borrowed(self) -> str:
        """Why `uid` says nothing about who put the thing there, or ""."""
        if strangers := sorted(self.owners - {0, self.uid}):
            return f"{user_name(strangers[0])} owns a directory above it"
        if self.shared:
            return f"users other than its owner can write to {shown(self.shared)}"
        return ""


@contextlib.contextmanager
def reached(path: str | Path) -> Iterator[tuple[int, Place]]:
    """A descriptor (O_PATH) of what is at the absolute `path`, and its place.

    Raises OSError, and DoraSystemdError (BAD_INPUT) for a link that somebody else could change.
    """
    with contextlib.ExitStack() as held:
        walk = _Walk(held)
        parts = _parts(str(path))
        while parts:
            parts = walk.enter(parts[0]) + parts[1:]
        yield walk.fd, walk.place(str(path))


def firm_part(path: str | Path, uid: int = 0, groups: Collection[int] = ()) -> str:
    """The longest part of the absolute `path` in which nobody but root can replace anything.

    It is what may be told to a program that walks paths as root and follows links, such as systemd
    when it mounts: what follows in `path` may be a link to anywhere by then.

    uid, groups: for whom it mounts. The part ends at a directory that is closed to that account,
    whatever it says that it sees behind: mounted by itself, what is in there would be open to it.
    """
    firm = "/"
    with contextlib.ExitStack() as held, contextlib.suppress(OSError, DoraSystemdError):
        walk = _Walk(held)
        for part in _parts(str(path)):
            ahead = [part]
            while ahead:
                if not (walk.is_firm(ahead[0]) and walk.is_open_to(uid, groups)):
                    return firm
                ahead = walk.enter(ahead[0]) + ahead[1:]
            firm = f"{firm.rstrip('/')}/{part}"
    return firm


def list_directory(path: str | Path, most: int) -> list[str]:
    """At most `most` of the names in the directory `path`, in order.

    Raises OSError, and DoraSystemdError as reached() does.
    """
    with reached(path) as (found, _):
        fd = os.open(f"/proc/self/fd/{found}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            with os.scandir(fd) as entries:
                return sorted(entry.name for entry in islice(entries, most))
        finally:
            os.close(fd)


def exists(path: str | Path) -> bool:
    """Whether something is there; a link that may not be followed counts as something."""
    try:
        with reached(path):
            return True
    except DoraSystemdError:
        return True
    except (OSError, ValueError):
        return False


def user_name(uid: int, nameless: str = "uid ") -> str:
    """The name of a uid; where it has none its number, behind `nameless`."""
    try:
        return pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError):
        return f"{nameless}{uid}"


class _Walk:
    """A walk from the root directory. Its descriptors are closed with `held`."""

    def __init__(self, held: contextlib.ExitStack) -> None:
        self._held = held
        self._links = 0
        self._cautious = os.geteuid() == 0
        self._begin()

    def _begin(self) -> None:
        self.fd = self._open("/", None)
        self._status = os.fstat(self.fd)
        self._owners = {self._status.st_uid}
        self._shared = ""
        self._where = ""

    def _open(self, name: str, parent: int | None) -> int:
        fd = os.open(name, _STEP, dir_fd=parent)
        self._held.callback(os.close, fd)
        return fd

    def enter(self, name: str) -> list[str]:
        """Go into `name`; what is to be walked first where that is a link."""
        fd = self._open(name, self.fd)
        status = os.fstat(fd)
        if stat.S_ISLNK(status.st_mode):
            return self._follow(name, status)
        self._shared = self._shared or self._sharing()
        self._where = f"{self._where}/{name}"
        self.fd, self._status = fd, status
        self._owners.add(status.st_uid)
        return []

    def is_firm(self, name: str) -> bool:
        """Whether root alone can put something else in the place of `name`. Raises OSError.

        In a sticky directory its owner can, too. A group counts whoever is in it: ACLs show as one.
        """
        if self._status.st_uid != 0:
            return False
        if not self._status.st_mode & (stat.S_IWOTH | stat.S_IWGRP):
            return True
        owner = os.stat(name, dir_fd=self.fd, follow_symlinks=False).st_uid
        return owner == 0 and bool(self._status.st_mode & stat.S_ISVTX)

    def is_open_to(self, uid: int, groups: Collection[int]) -> bool:
        """Whether an account may go through the directory that was reached, see inode(7).

        An ACL that lets it in by name does not count: that closes more than need be.
        """
        status, bit = self._status, stat.S_IXOTH
        if uid == status.st_uid:
            bit = stat.S_IXUSR
        elif status.st_gid in groups:
            bit = stat.S_IXGRP
        return uid == 0 or bool(status.st_mode & bit)

    def _follow(self, name: str, status: os.stat_result) -> list[str]:
        link = f"{self._where}/{name}"
        self._links += 1
        if self._links > _MAX_LINKS:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        if self._cautious and (self._owners | {status.st_uid} != {0} or self._sharing()):
            reason = f"{shown(link)} is a symbolic link that users other than root can change"
            raise refusal(link, reason, "give the path that it leads to")
        target = os.readlink(name, dir_fd=self.fd)
        if target.startswith("/"):
            self._begin()
        return _parts(target)

    def _sharing(self) -> str:
        """The directory that was reached, if more than its owner can replace what is in it."""
        mode, where = self._status.st_mode, self._where or "/"
        if not stat.S_ISDIR(mode) or mode & stat.S_ISVTX:
            return ""
        is_shared = mode & _OTHERS_WRITE or (mode & stat.S_IWGRP and self._has_members())
        return where if is_shared else ""

    def _has_members(self) -> bool:
        """Whether the group is more than its owner's own: user private groups bear his name."""
        with contextlib.suppress(KeyError):
            group = grp.getgrgid(self._status.st_gid)
            owner = user_name(self._status.st_uid)
            return group.gr_name != owner or not set(group.gr_mem) <= {owner}
        return True

    def place(self, path: str) -> Place:
        """Where the walk has arrived."""
        status, shared = self._status, self._shared or self._sharing()
        return Place(path, status.st_uid, status.st_mode, frozenset(self._owners), shared)


def _parts(path: str) -> list[str]:
    return [part for part in path.split("/") if part not in ("", ".")]


def refusal(path: str | Path, reason: str, hint: str) -> DoraSystemdError:
    """The error for a file that is not read."""
    return DoraSystemdError(f"cannot read {shown(str(path))}: {reason}", hint, ExitCode.BAD_INPUT)
