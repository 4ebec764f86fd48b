"""The kernel's table of TCP sockets: whose is the other end of a connection within this machine?

One socket is asked for by sock_diag(7); where the kernel has no such thing, the table is read from
proc_net_tcp(5), which takes the longer the more connections there have been in the last minute.
"""

import contextlib
import os
import socket
import struct
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))

Address = tuple[str, int]

_REACHED = ("127.0.0.1", "0.0.0.0", "::", "::ffff:127.0.0.1")
"""The addresses of listeners who get what is sent to 127.0.0.1."""

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
"""Of the fields uid and inode in an answer: behind a header, four bytes, the socket's identity (48
bytes) and three numbers, see linux/inet_diag.h."""


class Owner(NamedTuple):
    """Whose a socket is. inode: 0 for one that its process has closed; the kernel says uid 0 then,
    or did until Linux 6.16.
    """

    uid: int
    inode: int


Lookup = Callable[[Address, Address], Owner | None]


def peer_uid(peer: Address, own: Address, look: Lookup | None = None) -> int | None:
    """The user whose socket is bound to `peer` and connected to `own`; None if nobody can tell.

    A process that closes its socket while the kernel answers would be taken for root, and a long
    table may lack a line at one reading: only what two answers agree on counts.
    """
    look = look or find_owner
    before = None
    for _ in range(_TRIES):
        found = look(peer, own)
        found = found if found and found.inode else None
        if found is not None and found == before:
            return found.uid
        before = found
    return None


def find_owner(peer: Address, own: Address) -> Owner | None:
    """The owner of the socket that is bound to `peer` and connected to `own`.

    A reading of the table takes milliseconds, and who connects and vanishes again must not have
    us read it each time.
    """
    try:
        return _ask_kernel(peer, own)
    except FileNotFoundError:
        # No such socket, or nobody in the kernel who knows about TCP.
        if _kernel_knows():
            return None
    except (OSError, struct.error):
        pass
    return read_owner(peer, own)


@cache
def _kernel_knows() -> bool:
    """Whether the kernel tells of a socket that is there."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as one:
            return _ask_kernel(one.getsockname(), ("0.0.0.0", 0)).inode != 0
    except (OSError, struct.error):
        return False


def read_owner(peer: Address, own: Address, tables: tuple[Path, ...] = TABLES) -> Owner | None:
    """The same from the tables in /proc."""
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
    """The users who get the connections to a TCP port of 127.0.0.1."""
    ends = {_entry((address, port)) for address in _REACHED}
    found = (fields for fields in _listeners(port, tables) if fields[1] in ends)
    return frozenset(int(fields[7]) for fields in found)


def _listeners(port: int, tables: tuple[Path, ...]) -> Iterator[list[bytes]]:
    ending = b":%04X" % port
    for fields in _lines(tables, ending):
        if fields[3] == _LISTENING and fields[1].endswith(ending):
            yield fields


def _ask_kernel(peer: Address, own: Address) -> Owner:
    """Raises OSError where the kernel does not answer such questions, or knows no such socket."""
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
    """The fields of the lines that have `needle` in them; never a whole table in memory."""
    for table in tables:
        with contextlib.suppress(OSError), table.open("rb") as file:
            for line in file:
                if needle in line:
                    yield line.split()


def _entry(address: Address) -> bytes:
    """An address as in the table: words of 32 bits in this machine's order, and the port."""
    packed = _packed(address)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return b"%s:%04X" % (b"".join(b"%08X" % word for word in words), address[1])


def _packed(address: Address) -> bytes:
    return socket.inet_pton(_family(address), address[0])


def _family(address: Address) -> int:
    return socket.AF_INET6 if ":" in address[0] else socket.AF_INET
