"""Checks network interfaces that nodes need, and notices when interfaces change, by rtnetlink(7).

Not by files of /sys: inotify(7) reports no change there, and the CAN state is not in them. Not by
pyroute2: version 0.9.7 adds 12 MB to the private memory of a process, and this module 1 MB.
"""

import contextlib
import errno
import itertools
import os
import socket
import time

from dora_systemd.adapters.host.presence import Presence
from dora_systemd.decisions.needs.links import (
    LINK_GROUP,
    Link,
    format_link_request,
    link_problem,
    parse_link,
)

_SECONDS = 1.0
_BUFFER = 32 * 1024
_MOST = 64
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
    number, deadline = next(_sequences), time.monotonic() + _SECONDS
    with _socket() as one:
        one.settimeout(_SECONDS)
        one.sendto(format_link_request(name, number), (0, 0))
        while time.monotonic() < deadline:
            answer, sender = one.recvfrom(_BUFFER)
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
        """The descriptor to poll."""
        return self._socket.fileno()

    def drain(self) -> None:
        """Read and discard messages, because any message means only that something has changed.

        The kernel reports ENOBUFS once if messages were lost.
        """
        with contextlib.suppress(OSError):
            for _ in range(_MOST):
                self._socket.recv(1)

    def close(self) -> None:
        """Stop watching."""
        self._socket.close()


def _socket() -> socket.socket:
    kind = socket.SOCK_RAW | socket.SOCK_CLOEXEC
    return socket.socket(socket.AF_NETLINK, kind, socket.NETLINK_ROUTE)
