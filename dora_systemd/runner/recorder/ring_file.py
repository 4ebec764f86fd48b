"""The memory of a ring: a memfd that systemd keeps open, and the socket that hands it out."""

import asyncio
import contextlib
import fcntl
import os
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.host import fd_store
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    Header,
    format_header,
    parse_header,
    size_of,
    span_of,
)
from dora_systemd.errors import DoraSystemdError

_SEALS = fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_SEAL
"""The nodes' user has the file, and must not change its size."""
_NS = 1000


def header_of(record: Record, outputs: Sequence[str], facts: Mapping[str, str]) -> Header:
    """The header of a ring for `outputs`. facts: for the file that is made of the ring."""
    span, is_small = span_of(record.memory), not record.outputs
    return Header(outputs, span, record.memory, record.last * _NS, is_small, facts)


def fitted_ring(inherited: int, header: Header) -> int:
    """The ring that an earlier life has left, if it has the same form; else another one.

    inherited: its descriptor, or -1. Raises OSError, and DoraSystemdError for too many outputs.
    """
    try:
        data = format_header(header)
    except ValueError as error:
        message = f"cannot record all outputs: {error}"
        raise DoraSystemdError(message, "name some in the setting record") from error
    if inherited >= 0 and _fits(inherited, header):
        os.pwrite(inherited, data, 0)  # the facts are those of this life
        return inherited
    free_ring(inherited)
    fd = os.memfd_create(fd_store.RING, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size_of(header))
    os.pwrite(fd, data, 0)
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    fd_store.store_ring(fd)
    return fd


def _fits(fd: int, header: Header) -> bool:
    with contextlib.suppress(OSError, ValueError):
        found = parse_header(os.pread(fd, ALIGN, 0))
        return found._replace(facts={}, outputs=tuple(found.outputs)) == header._replace(
            facts={}, outputs=tuple(header.outputs)
        )
    return False


def free_ring(fd: int) -> None:
    """Close a ring, and have systemd close it: the memory is free. fd: or -1."""
    if fd >= 0:
        os.close(fd)
        fd_store.forget_ring()


class RingSocket:
    """Sends the descriptor of a ring to everyone who connects to `path`. Raises OSError."""

    def __init__(self, path: Path, ring: int) -> None:
        self._path, self._ring = path, ring
        path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        self._socket.bind(str(path))
        self._socket.listen(1)
        asyncio.get_running_loop().add_reader(self._socket, self._answer)

    def _answer(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._socket.accept()
            with connection:
                connection.setblocking(False)
                socket.send_fds(connection, [b"r"], [self._ring])

    def close(self) -> None:
        """Close the socket, but not the ring."""
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()
        self._path.unlink(missing_ok=True)
