"""Opens paths that other users may own: walks by file descriptor, and bounds every read.

The rules are those of systemd's own chase() with CHASE_SAFE:

- The walk opens one component after the other by descriptor. It follows a symbolic link only if
  root alone can replace the link.
- The owner of a directory controls its entries. So below a directory that root does not own, a file
  counts as its owner's only if that user or root owns all directories above it. Otherwise it is
  "borrowed": someone may have linked or moved it there.
- The owner is read from the descriptor that is used, never from a path.
- Only regular files are read, and only up to a limit. No path can make a read hang.

These rules protect root. For other callers the permissions of the files are enough, so nothing is
refused.
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

from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import shell_word, shown

_MAX_LINKS = 40
STEP = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
"""Flags to open one component of a path, which may be anything."""


class Place(NamedTuple):
    """The end of a walk."""

    path: str
    uid: int  # owner of the file or directory
    mode: int
    owners: frozenset[int]  # owners of it and of all directories above it
    # a directory on the way, or at the end, in which users other than its owner can replace
    # entries, or ""
    shared: str = ""

    @property
    def is_roots(self) -> bool:
        """Whether only root can change or replace it."""
        others_write = self.mode & (stat.S_IWOTH | stat.S_IWGRP)
        return self.owners == {0} and not self.shared and not others_write

    @property
    def changeable(self) -> str:
        """How other users than root can have changed the file, or "". A group counts as others."""
        if self.uid != 0:
            return "the file is not root's"
        if self.borrowed:
            return self.borrowed
        is_shared = self.mode & (stat.S_IWOTH | stat.S_IWGRP)
        return "others than root can write to the file" if is_shared else ""

    @property
    def is_open(self) -> bool:
        """Whether it is a directory in which every user can create files, such as /tmp."""
        return stat.S_ISDIR(self.mode) and bool(self.mode & stat.S_IWOTH)

    @property
    def borrowed(self) -> str:
        """Why `uid` need not be the user who put the file there, or ""."""
        if strangers := sorted(self.owners - {0, self.uid}):
            return f"{user_name(strangers[0])} owns a directory above it"
        if self.shared:
            return f"users other than its owner can write to {shown(self.shared)}"
        return ""


def hint_of_changeable(path: Path, roots: Path, otherwise: str) -> str:
    """Return the hint about a file that others than root can change.

    roots: the file that root is meant to write. otherwise: what to do instead of using another one.
    """
    file = shell_word(str(roots))
    return f"chown root: {file}; chmod go-w {file}" if path == roots else otherwise


@contextlib.contextmanager
def reached(path: str | Path) -> Iterator[tuple[int, Place]]:
    """Walk to the absolute `path`; a descriptor (O_PATH) and its place.

    Raises OSError, and DoraSystemdError (BAD_INPUT) for a link that another user could change.
    """
    with contextlib.closing(_Walk()) as walk:
        parts = _parts(str(path))
        while parts:
            parts = walk.enter(parts[0]) + parts[1:]
        yield walk.fd, walk.place(str(path))


def firm_part(path: str | Path, uid: int = 0, groups: Collection[int] = ()) -> str:
    """The longest part of the absolute `path` in which only root can replace anything.

    Only this part may be passed to a program that walks paths as root and follows links, such as
    systemd when it mounts. The rest of `path` may have become a link to anywhere by then.

    uid, groups: the account for which systemd mounts. The part ends at a directory that this
    account cannot enter, even if the account claims to see what is in it: a mount of its content
    would give the account access.
    """
    firm = "/"
    with contextlib.suppress(OSError, DoraSystemdError), contextlib.closing(_Walk()) as walk:
        for part in _parts(str(path)):
            ahead = [part]
            while ahead:
                if not (walk.is_firm(ahead[0]) and walk.is_open_to(uid, groups)):
                    return firm
                ahead = walk.enter(ahead[0]) + ahead[1:]
            firm = f"{firm.rstrip('/')}/{part}"
    return firm


def list_directory(path: str | Path, most: int) -> list[str]:
    """At most `most` of the names in the directory `path`, sorted.

    Raises OSError, and DoraSystemdError as reached() does.
    """
    with reached(path) as (found, _), os.scandir(f"/proc/self/fd/{found}") as entries:
        return sorted(entry.name for entry in islice(entries, most))


def exists(path: str | Path) -> bool:
    """Whether something exists at `path`; a link that must not be followed counts as existing."""
    try:
        with reached(path):
            return True
    except DoraSystemdError:
        return True
    except (OSError, ValueError):
        return False


def is_absent(path: str | Path) -> bool:
    """Whether nothing exists at `path`; False if the caller may not look there."""
    try:
        with reached(path):
            return False
    except (DoraSystemdError, PermissionError):
        return False
    except (OSError, ValueError):
        return True


def is_link(path: Path) -> bool:
    """Whether the last component of `path` is a symbolic link, wherever that leads."""
    try:
        with reached(path.parent) as (parent, _):
            return stat.S_ISLNK(os.lstat(path.name, dir_fd=parent).st_mode)
    except (DoraSystemdError, OSError, ValueError):
        return False


def is_directory(path: str | Path) -> bool:
    """Whether a directory exists at `path`; not for a link that must not be followed."""
    try:
        with reached(path) as (_, place):
            return stat.S_ISDIR(place.mode)
    except (DoraSystemdError, OSError, ValueError):
        return False


def sync_directory(path: str | Path) -> None:
    """Make the names in a directory durable, see fsync(2). Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def user_name(uid: int, nameless: str = "uid ") -> str:
    """The name of a uid; where it has none its number, behind `nameless`."""
    try:
        return pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError):
        return f"{nameless}{uid}"


def other_user(uid: int) -> str:
    """Return the name of the user `uid`; "" if that is root or the caller."""
    return "" if uid in (0, os.geteuid()) else user_name(uid)


class _Walk:
    """A walk from the root directory, with one descriptor however long the path is."""

    def __init__(self) -> None:
        self._links = 0
        self._cautious = os.geteuid() == 0
        self.fd = os.open("/", STEP)
        self._begin()

    def close(self) -> None:
        os.close(self.fd)

    def _begin(self) -> None:
        self._status = os.fstat(self.fd)
        self._owners = {self._status.st_uid}
        self._shared = ""
        self._where = ""

    def enter(self, name: str) -> list[str]:
        """Enter `name`. If that is a link, return the components to walk instead of it."""
        fd = os.open(name, STEP, dir_fd=self.fd)
        status = os.fstat(fd)
        if stat.S_ISLNK(status.st_mode):
            os.close(fd)
            return self._follow(name, status)
        self._go(fd)
        self._shared = self._shared or self._sharing()
        self._where = f"{self._where}/{name}"
        self._status = status
        self._owners.add(status.st_uid)
        return []

    def _go(self, fd: int) -> None:
        os.close(self.fd)
        self.fd = fd

    def is_firm(self, name: str) -> bool:
        """Whether only root can replace the entry `name`. Raises OSError.

        In a sticky directory the entry's owner can replace it too. A group with write permission
        counts as other users, whoever its members are: the mask of an ACL shows as group
        permission.
        """
        if self._status.st_uid != 0:
            return False
        if not self._status.st_mode & (stat.S_IWOTH | stat.S_IWGRP):
            return True
        owner = os.stat(name, dir_fd=self.fd, follow_symlinks=False).st_uid
        return owner == 0 and bool(self._status.st_mode & stat.S_ISVTX)

    def is_open_to(self, uid: int, groups: Collection[int]) -> bool:
        """Whether an account may search the current directory, see inode(7).

        An ACL entry for a named user does not count, which refuses more than necessary.
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
            self._go(os.open("/", STEP))
            self._begin()
        return _parts(target)

    def _sharing(self) -> str:
        """The current directory, if users other than its owner can replace its entries, or ""."""
        mode, where = self._status.st_mode, self._where or "/"
        if not stat.S_ISDIR(mode) or mode & stat.S_ISVTX:
            return ""
        is_shared = mode & stat.S_IWOTH or (mode & stat.S_IWGRP and self._has_members())
        return where if is_shared else ""

    def _has_members(self) -> bool:
        """Whether others than the owner are members; a user private group has the user's name."""
        with contextlib.suppress(KeyError):
            group = grp.getgrgid(self._status.st_gid)
            owner = user_name(self._status.st_uid)
            return group.gr_name != owner or not set(group.gr_mem) <= {owner}
        return True

    def place(self, path: str) -> Place:
        """The place of the current file or directory."""
        status, shared = self._status, self._shared or self._sharing()
        return Place(path, status.st_uid, status.st_mode, frozenset(self._owners), shared)


def _parts(path: str) -> list[str]:
    return [part for part in path.split("/") if part not in ("", ".")]


def refusal(path: str | Path, reason: str, hint: str) -> DoraSystemdError:
    """The error for a file that is not read."""
    return bad_input(f"cannot read {shown(str(path))}: {reason}", hint)
