"""Connects to sockets that other users own, and checks the other end before it sends anything.

Only root can give a RuntimeDirectory to a user, so the owner of the directory is the user of the
unit. That user can replace everything in it. A Unix socket there counts if that user owns it, it is
not a link, and a process of that user listens: then only the owner of the dataflow receives what is
sent. Any user can listen on a port of 127.0.0.1, so the listener must have that uid.
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
from dora_systemd.trust.paths import STEP, reached, user_name
from dora_systemd.trust.socket_table import loopback_listeners
from dora_systemd.values import shown

_CREDENTIALS = struct.Struct("=iII")
"""pid, uid and gid, see SO_PEERCRED in unix(7)."""

_MAX_SHOWN = 2000

Peer = Callable[[socket.socket], int]


def peer_of(stream: socket.socket) -> int:
    """The uid of the listener, as it was at listen(2)."""
    found = stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(found)[1])


def connect_unix(path: Path, seconds: float, peer: Peer = peer_of) -> socket.socket:
    """Connect to the socket at the absolute `path`, which belongs to the owner of its directory.

    seconds: timeout of each operation. Raises OSError, and DoraSystemdError (NO_PERMISSION) if
    another user owns the socket or listens.
    """
    with contextlib.ExitStack() as held:
        directory, place = held.enter_context(reached(path.parent))
        if place.borrowed:
            raise _refusal(path, place.borrowed)
        fd = os.open(path.name, STEP, dir_fd=directory)
        held.callback(os.close, fd)
        status = os.fstat(fd)
        if not stat.S_ISSOCK(status.st_mode):
            raise _refusal(path, "it is not a socket")
        _check_owner(path, status.st_uid, place.uid)
        stream = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        undo = held.enter_context(contextlib.ExitStack())
        undo.callback(stream.close)
        stream.settimeout(seconds)
        # Connect to the file that was checked, even if its name leads elsewhere by now.
        stream.connect(f"/proc/self/fd/{fd}")
        _check_owner(path, peer(stream), place.uid)
        undo.pop_all()
        return stream


def require_listener(
    port: int, uid: int, listeners: Callable[[int], frozenset[int]] = loopback_listeners
) -> None:
    """Return if only `uid` listens on a port of 127.0.0.1.

    Raises DoraSystemdError: NOT_RUNNING if there is no listener, NO_PERMISSION for another user's.
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
