"""Sockets that others own: whose the other end is, before anything is sent to it.

The RuntimeDirectory of a unit is systemd's work: root alone can give it to somebody, so its owner
is whom the unit runs as. What lies in it is that user's to replace. A socket there counts if it is
owned by the same user, no link, and listened to by a process of that user: then whatever is said
to it is said to nobody but the owner of the dataflow. A port of 127.0.0.1 is anybody's; it counts
if its listener has that uid.
"""

import contextlib
import os
import socket
import stat
import struct
from collections.abc import Callable
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import short_line
from dora_systemd.trust.paths import reached, user_name
from dora_systemd.trust.socket_table import loopback_listeners
from dora_systemd.values import shown

_STEP = os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC
_CREDENTIALS = struct.Struct("=iII")
"""pid, uid and gid, see SO_PEERCRED in unix(7)."""

_MAX_SHOWN = 2000

Peer = Callable[[socket.socket], int]


def peer_of(stream: socket.socket) -> int:
    """The uid of who listens at the other end, as it was when it began to."""
    found = stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(found)[1])


def connect_unix(path: Path, seconds: float, peer: Peer = peer_of) -> socket.socket:
    """A connection to the socket at the absolute `path`, of the user who owns its directory.

    seconds: timeout of each operation on it. Raises OSError, and DoraSystemdError (NO_PERMISSION)
    for a socket, or a listener, of anybody else.
    """
    with contextlib.ExitStack() as held:
        directory, place = held.enter_context(reached(path.parent))
        if place.borrowed:
            raise _refusal(path, place.borrowed)
        fd = os.open(path.name, _STEP, dir_fd=directory)
        held.callback(os.close, fd)
        status = os.fstat(fd)
        if not stat.S_ISSOCK(status.st_mode):
            raise _refusal(path, "it is not a socket")
        _check_owner(path, status.st_uid, place.uid)
        stream = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        undo = held.enter_context(contextlib.ExitStack())
        undo.callback(stream.close)
        stream.settimeout(seconds)
        # The very socket that was looked at, whatever its name leads to by now.
        stream.connect(f"/proc/self/fd/{fd}")
        _check_owner(path, peer(stream), place.uid)
        undo.pop_all()
        return stream


def require_listener(
    port: int, uid: int, listeners: Callable[[int], frozenset[int]] = loopback_listeners
) -> None:
    """Return if only `uid` listens on a port of 127.0.0.1.

    Raises DoraSystemdError: NOT_RUNNING if nobody does, NO_PERMISSION if somebody else does.
    """
    found = listeners(port)
    what = f"cannot use port {port} of 127.0.0.1"
    if not found:
        hint = "the dataflow may be starting or stopping; see doractl list"
        raise DoraSystemdError(f"{what}: nothing listens there", hint, ExitCode.NOT_RUNNING)
    if strangers := sorted(found - {uid}):
        reason = f"{user_name(strangers[0])} listens there, not {user_name(uid)}"
        hint = f"a process of {user_name(uid)} named it; stop that dataflow"
        raise DoraSystemdError(f"{what}: {reason}", hint, ExitCode.NO_PERMISSION)


def plain(text: str) -> str:
    """`text` of the other end for a message."""
    return short_line(text, _MAX_SHOWN)


def _check_owner(path: Path, found: int, expected: int) -> None:
    if found != expected:
        reason = f"it is {user_name(found)}'s, its directory {user_name(expected)}'s"
        raise _refusal(path, reason)


def _refusal(path: Path, reason: str) -> DoraSystemdError:
    message = f"cannot connect to {shown(str(path))}: {reason}"
    return DoraSystemdError(message, "restart that dataflow", ExitCode.NO_PERMISSION)
