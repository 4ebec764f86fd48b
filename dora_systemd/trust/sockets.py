"""Connects to sockets that other users own, and finds the user at the other end of a connection.

Only root can give a RuntimeDirectory to a user, so the owner of the directory is the user of the
unit. That user can replace everything in it. A Unix socket there counts if that user owns it, it is
not a link, and a process of that user listens: then only the owner of the dataflow receives what is
sent. Any user can listen on a port of 127.0.0.1, so the listener must have that uid.

The kernel has the owner of each TCP socket in its table of sockets: sock_diag(7) answers for one
socket. If the kernel lacks it, proc_net_tcp(5) has the whole table, which takes longer the more
connections there were in the last minute.
"""

import contextlib
import os
import socket
import stat
import struct
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import short_line
from dora_systemd.trust.paths import STEP, reached, user_name
from dora_systemd.values import shown

TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))

Address = tuple[str, int]

_REACHED = ("127.0.0.1", "0.0.0.0", "::", "::ffff:127.0.0.1")
"""Addresses of listeners that receive connections to 127.0.0.1."""

_TRIES = 5
_LISTENING = b"0A"

_SOCK_DIAG = 4
_BY_FAMILY = 20
_REQUEST = 1
_ANY_STATE = 0xFFFFFFFF
_NO_COOKIE = b"\xff" * 8
_HEADER = struct.Struct("=IHHII")
_QUESTION = struct.Struct("=BBBBI")
_OWNER_PLACE = _HEADER.size + 4 + 48 + 12
"""Offset of the fields uid and inode in an answer: after a header, four bytes, the socket's
identity (48 bytes) and three numbers, see linux/inet_diag.h."""


class Owner(NamedTuple):
    """The owner of a socket."""

    uid: int
    # 0 if its process has closed it. Kernels before Linux 6.16 then report uid 0
    inode: int


Ask = Callable[[Address, Address], Owner]
Lookup = Callable[[Address, Address], Owner | None]


def peer_uid(peer: Address, own: Address, look: Lookup | None = None) -> int | None:
    """The uid that owns the socket bound to `peer` and connected to `own`; None if unknown.

    A process that closes its socket while the kernel answers would look like root, and one reading
    of a long table may miss a line. So the result counts only if two answers agree.
    """
    look = look or find_owner
    before = None
    for _ in range(_TRIES):
        found = look(peer, own)
        if found and found.inode and found == before:
            return found.uid
        before = found
    return None


def find_owner(
    peer: Address, own: Address, ask: Ask | None = None, read: Lookup | None = None
) -> Owner | None:
    """The owner of the socket that is bound to `peer` and connected to `own`.

    Reading the table takes milliseconds. A client that connects and disconnects at once must not
    cause a reading each time. `ask`: queries the kernel. `read`: reads the table.
    """
    ask, read = ask or _ask_kernel, read or read_owner
    try:
        return ask(peer, own)
    except FileNotFoundError:
        # No such socket, or a kernel that does not support TCP here.
        if _kernel_knows(ask):
            return None
    except (OSError, struct.error):
        pass
    return read(peer, own)


@cache
def _kernel_knows(ask: Ask) -> bool:
    """Whether the kernel answers for a socket that exists."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as one:
            return ask(one.getsockname(), ("0.0.0.0", 0)).inode != 0
    except (OSError, struct.error):
        return False


def read_owner(peer: Address, own: Address, tables: tuple[Path, ...] = TABLES) -> Owner | None:
    """Find the owner in the tables of /proc."""
    try:
        ends = [_entry(peer), _entry(own)]
    except (OSError, struct.error):
        return None
    for fields in _lines(tables, b" ".join(ends)):
        if fields[1:3] == ends:
            return Owner(int(fields[7]), int(fields[9]))
    return None


def listener_uids(port: int, tables: tuple[Path, ...] = TABLES) -> frozenset[int]:
    """The users who listen on a TCP port, whatever the address."""
    return frozenset(int(fields[7]) for fields in _listeners(port, tables))


def listening_sockets(port: int, tables: tuple[Path, ...] = TABLES) -> frozenset[int]:
    """Inodes of the sockets that listen on a TCP port, whatever the address."""
    return frozenset(int(fields[9]) for fields in _listeners(port, tables))


def loopback_listeners(port: int, tables: tuple[Path, ...] = TABLES) -> frozenset[int]:
    """The users that receive connections to a TCP port of 127.0.0.1."""
    ends = {_entry((address, port)) for address in _REACHED}
    found = (fields for fields in _listeners(port, tables) if fields[1] in ends)
    return frozenset(int(fields[7]) for fields in found)


def is_open_beyond(port: int, tables: tuple[Path, ...] = TABLES) -> bool:
    """Whether something listens on a TCP port of another address than 127.0.0.1 and ::1."""
    own = {_entry(("127.0.0.1", port)), _entry(("::1", port))}
    return any(fields[1] not in own for fields in _listeners(port, tables))


def _listeners(port: int, tables: tuple[Path, ...]) -> Iterator[list[bytes]]:
    ending = b":%04X" % port
    for fields in _lines(tables, ending):
        if fields[3] == _LISTENING and fields[1].endswith(ending):
            yield fields


def _ask_kernel(peer: Address, own: Address) -> Owner:
    """Query the kernel by sock_diag(7).

    Raises OSError if the kernel does not support sock_diag or has no such socket.
    """
    family, source, target = _family(peer), _packed(peer), _packed(own)
    identity = struct.pack("!HH16s16sI8s", peer[1], own[1], source, target, 0, _NO_COOKIE)
    question = _QUESTION.pack(family, socket.IPPROTO_TCP, 0, 0, _ANY_STATE) + identity
    size = _HEADER.size + len(question)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _SOCK_DIAG) as one:
        one.settimeout(1.0)
        one.sendto(_HEADER.pack(size, _BY_FAMILY, _REQUEST, 1, 0) + question, (0, 0))
        answer = one.recv(4096)
    if _HEADER.unpack_from(answer)[1] != _BY_FAMILY:
        (number,) = struct.unpack_from("=i", answer, _HEADER.size)
        raise OSError(-number, os.strerror(-number))
    return Owner(*struct.unpack_from("=II", answer, _OWNER_PLACE))


def _lines(tables: tuple[Path, ...], needle: bytes) -> Iterator[list[bytes]]:
    """The fields of the lines that contain `needle`; reads the tables line by line."""
    for table in tables:
        with contextlib.suppress(OSError), table.open("rb") as file:
            for line in file:
                if needle in line:
                    yield line.split()


def _entry(address: Address) -> bytes:
    """An address as in the table: 32-bit words in this machine's byte order, and the port."""
    packed = _packed(address)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return b"%s:%04X" % (b"".join(b"%08X" % word for word in words), address[1])


def _packed(address: Address) -> bytes:
    return socket.inet_pton(_family(address), address[0])


def _family(address: Address) -> int:
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET


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
        raise _refusal(path, f"it is {user_name(found)}'s, its directory {user_name(expected)}'s")


def _refusal(path: Path, reason: str) -> DoraSystemdError:
    message = f"cannot connect to {shown(str(path))}: {reason}"
    return DoraSystemdError(message, "restart that dataflow", ExitCode.NO_PERMISSION)
