"""Checks what nodes need: paths and the directories to watch, network interfaces and their changes.

The runner checks with the rights and the view of its nodes, so a node learns nothing new from it.

Interfaces by rtnetlink(7), not by files of /sys: inotify(7) reports no change there, and the CAN
state is not in them. Not by pyroute2: version 0.9.7 adds 12 MB to the private memory of a process,
and this module 1 MB.
"""

import contextlib
import errno
import itertools
import os
import socket
import stat
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.needs.links import (
    LINK_GROUP,
    Link,
    format_link_request,
    link_problem,
    parse_link,
)

_MOST_LINKS = 40


class Presence(NamedTuple):
    """The state of a path.

    A device that was unplugged and plugged in between two looks has another identity.
    """

    reason: str = ""  # why it cannot be used, or ""
    identity: tuple[int, ...] | None = None  # of a device or an interface


def look_at(path: str) -> Presence:
    """Check what is at `path`, behind links."""
    try:
        found = Path(path).stat()
    except PermissionError:
        return Presence("no permission to look there")
    except OSError:
        return Presence("not there")
    # udev sets owner and group of a device after the kernel has made it.
    if not os.access(path, os.R_OK):
        return Presence("no permission to read it")
    is_device = stat.S_ISCHR(found.st_mode) or stat.S_ISBLK(found.st_mode)
    return Presence("", (found.st_dev, found.st_ino, found.st_rdev) if is_device else None)


def watched_places(paths: Iterable[str]) -> set[str]:
    """Return the directories in which one of `paths` can appear or disappear.

    These are the nearest existing directories of each path and of the links on the way to it.
    """
    return {place for path in paths for place in _places(path)}


def are_devices(paths: Iterable[str], places: Iterable[str]) -> bool:
    """Whether all paths are in /dev, also behind their links. places: of watched_places().

    No other machine changes anything there, and nothing is mounted over a device.
    """
    every = (*paths, *(one for one in places if one != "/"))
    return all(f"{one}/".startswith("/dev/") for one in every)


def _places(path: str) -> set[str]:
    found: set[str] = set()
    for _ in range(_MOST_LINKS):
        found |= _existing(path)
        link = _first_link(path)
        if link is None:
            break
        path = link
    return found


def _existing(path: str) -> set[str]:
    """Return the nearest existing directory above `path`, and the parent of that directory.

    A watch on the parent notices when the directory is moved away.
    """
    parent = next(one for one in Path(path).parents if _is_directory(one) or one == one.parent)
    return {str(parent), str(parent.parent)}


def _is_directory(path: Path) -> bool:
    """Whether `path` is a directory; False also without permission to find out."""
    return os.path.isdir(path)  # noqa: PTH112 - up to Python 3.13, is_dir() raises for EACCES


def _first_link(path: str) -> str | None:
    """The path behind the first link in it, or None without one."""
    for place in [*reversed(Path(path).parents), Path(path)]:
        with contextlib.suppress(OSError):
            behind = place.parent / place.readlink() / Path(path).relative_to(place)
            return os.path.normpath(behind)
    return None


_ANSWER_SECONDS = 1.0
_MESSAGE_BYTES = 32 * 1024
_MOST_MESSAGES = 64
"""Messages that one call reads: the kernel may send without a pause."""
_sequences = itertools.count(1)


def look_at_link(name: str) -> Presence:
    """Check the interface `name`, in the network namespace of the caller."""
    try:
        link = _read_link(name)
    except OSError as error:
        if error.errno == errno.ENODEV:
            return Presence("not there")
        return Presence(f"cannot be read: {error.strerror or error}")
    problem = link_problem(link)
    return Presence(problem, None if problem else (link.number,))


def _read_link(name: str) -> Link:
    """The kernel's answer. Raises OSError; without such an interface its errno is ENODEV."""
    number, deadline = next(_sequences), time.monotonic() + _ANSWER_SECONDS
    with _socket() as one:
        one.settimeout(_ANSWER_SECONDS)
        one.sendto(format_link_request(name, number), (0, 0))
        while time.monotonic() < deadline:
            answer, sender = one.recvfrom(_MESSAGE_BYTES)
            if sender[0] != 0 or (link := parse_link(answer, number)) is None:
                continue
            if link.error:
                raise OSError(link.error, os.strerror(link.error))
            return link
    raise TimeoutError("the kernel does not answer")


class LinkChanges:
    """A socket that is readable when an interface of this machine has changed. Close it.

    Raises OSError where the sandbox does not allow AF_NETLINK.
    """

    def __init__(self) -> None:
        self._socket = _socket()
        self._socket.setblocking(False)
        self._socket.bind((0, LINK_GROUP))

    @property
    def fd(self) -> int:
        return self._socket.fileno()

    def drain(self) -> None:
        """Read and discard messages, because any message means only that something has changed.

        The kernel reports ENOBUFS once if messages were lost.
        """
        with contextlib.suppress(OSError):
            for _ in range(_MOST_MESSAGES):
                self._socket.recv(1)

    def close(self) -> None:
        self._socket.close()


def _socket() -> socket.socket:
    kind = socket.SOCK_RAW | socket.SOCK_CLOEXEC
    return socket.socket(socket.AF_NETLINK, kind, socket.NETLINK_ROUTE)
