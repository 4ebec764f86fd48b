"""The kernel's table of TCP sockets, proc_net_tcp in the kernel's documentation: whose is the other
end of a connection within this machine?
"""

import contextlib
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))

Address = tuple[str, int]

_TRIES = 5
_LISTENING = "0A"


class Owner(NamedTuple):
    """Whose a socket is. inode: 0 for one that its process has closed; the kernel says uid 0 then,
    or did until Linux 6.16.
    """

    uid: int
    inode: int


def peer_uid(peer: Address, own: Address, tables: tuple[Path, ...] = TABLES) -> int | None:
    """The user whose socket is bound to `peer` and connected to `own`; None if nobody can tell.

    A process that closes its socket while the kernel writes the line would be taken for root, and
    a long table may lack a line at one reading: only what two readings agree on counts.
    """
    before = None
    for _ in range(_TRIES):
        found = _owner(peer, own, tables)
        if found is not None and found == before:
            return found.uid
        before = found
    return None


def listener_uids(port: int, tables: tuple[Path, ...] = TABLES) -> frozenset[int]:
    """The users who listen on a TCP port, whatever the address."""
    ending = f":{port:04X}"
    return frozenset(
        int(fields[7])
        for fields in _lines(tables)
        if fields[3] == _LISTENING and fields[1].endswith(ending)
    )


def _owner(peer: Address, own: Address, tables: tuple[Path, ...]) -> Owner | None:
    try:
        ends = [_entry(peer), _entry(own)]
    except (OSError, struct.error):
        return None
    for fields in _lines(tables):
        if fields[1:3] == ends:
            owner = Owner(int(fields[7]), int(fields[9]))
            return owner if owner.inode else None
    return None


def _lines(tables: tuple[Path, ...]) -> Iterator[list[str]]:
    for table in tables:
        with contextlib.suppress(OSError):
            yield from (line.split() for line in table.read_text().splitlines()[1:])


def _entry(address: Address) -> str:
    """An address as in the table: words of 32 bits in this machine's order, and the port."""
    host, port = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    packed = socket.inet_pton(family, host)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return f"{''.join(f'{word:08X}' for word in words)}:{port:04X}"
