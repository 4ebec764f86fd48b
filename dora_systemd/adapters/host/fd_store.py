"""systemd's file descriptor store: keeps descriptors when the runner dies.

While systemd holds a pipe open, its content is not lost. See FDSTORE=1 in sd_notify(3) and
FileDescriptorStoreMax= in systemd.service(5).
"""

import contextlib
import os
import socket
from collections.abc import Iterable

from dora_systemd.decisions.cell.restarts import MOST_COUNTED

PREFIX = "dora-log-"
"""Prefix of the names of pipes; the rest is the node, so that they can be removed by node."""
LIFE = "dora-life"
"""Name of a descriptor that stands for one life of the runner since the last quiet window."""
RING = "dora-ring"
"""Name of the memory that has the last messages of the nodes, see decisions/recorder/."""
_MOST_DIGITS = 32
_FIRST = 3  # SD_LISTEN_FDS_START, see sd_listen_fds(3)


def store(fd: int, node: str) -> None:
    """Have systemd keep `fd` open too; does nothing without systemd, or without a store."""
    _send(f"FDSTORE=1\nFDNAME={PREFIX}{node}\nFDPOLL=0", [fd])


def forget(node: str) -> None:
    """Have systemd close the pipes of a node that does not come back."""
    _forget(PREFIX + node)


def _forget(name: str) -> None:
    _send(f"FDSTOREREMOVE=1\nFDNAME={name}", [])


def store_ring(fd: int) -> None:
    """Have systemd keep the ring of the recorder."""
    _send(f"FDSTORE=1\nFDNAME={RING}\nFDPOLL=0", [fd])


def forget_ring() -> None:
    """Have systemd close the ring of the recorder."""
    _forget(RING)


def inherited_ring() -> int:
    """The descriptor of the ring that an earlier life has left, or -1."""
    rings = _inherited(RING)
    for fd in rings:
        os.set_inheritable(fd, False)
    return rings[-1] if rings else -1


def lives() -> int:
    """Number of earlier lives since the last quiet window, at most MOST_COUNTED.

    systemd keeps these descriptors over restarts, and closes them when the unit is stopped.
    `systemd-analyze fdstore` shows them.
    """
    return len(_lives())


def life_times() -> list[int]:
    """Read when the lives began that lives() counts, CLOCK_BOOTTIME µs, oldest first."""
    return sorted(map(_read_time, _lives()))


def _read_time(fd: int) -> int:
    """The time in the descriptor of a life; 0, which is long ago, if there is none."""
    with contextlib.suppress(OSError, ValueError):
        return int(os.pread(fd, _MOST_DIGITS, 0))
    return 0


def _lives() -> list[int]:
    """The inherited descriptors that stand for a life."""
    return _inherited(LIFE)


def _inherited(wanted: str) -> list[int]:
    if os.environ.get("LISTEN_PID", "") != str(os.getpid()):
        return []
    names = os.environ.get("LISTEN_FDNAMES", "").split(":")
    return [fd for fd, name in enumerate(names, _FIRST) if name == wanted]


def count_life(began_us: int) -> None:
    """Count this life. began_us: CLOCK_BOOTTIME."""
    if lives() < MOST_COUNTED:
        # A new file each time: systemd stores the same file only once.
        fd = os.memfd_create(LIFE, os.MFD_CLOEXEC)
        os.write(fd, str(began_us).encode())
        _send(f"FDSTORE=1\nFDNAME={LIFE}\nFDPOLL=0", [fd])
        os.close(fd)


def outlasts_failure() -> bool:
    """Whether systemd has FileDescriptorStorePreserve=: 254 has, and sets $FDSTORE."""
    return "FDSTORE" in os.environ


def is_first_life() -> bool:
    """Whether no life before this one has counted itself since systemd loaded the unit.

    False also if systemd is older than 254 and does not set $FDSTORE, see systemd.exec(5): then
    systemd may keep no descriptors.
    """
    return outlasts_failure() and not os.environ.get("LISTEN_FDNAMES")


def forget_lives() -> None:
    """Restart the count. A file without a node shows the next life that it is not the first."""
    fd = os.memfd_create(PREFIX, os.MFD_CLOEXEC)
    store(fd, "")
    os.close(fd)
    _forget(LIFE)


def forget_inherited() -> None:
    """Close what an earlier life left in the store, and remove its pipes from the store."""
    if os.environ.pop("LISTEN_PID", "") != str(os.getpid()):
        return
    names = os.environ.pop("LISTEN_FDNAMES", "").split(":")
    count = int(os.environ.pop("LISTEN_FDS", "0"))
    for fd, name in zip(range(_FIRST, _FIRST + count), names, strict=False):
        if name.startswith(PREFIX) or name == LIFE:
            os.close(fd)
    for name in sorted({*names}):
        if name.startswith(PREFIX):
            _forget(name)


def forget_all(nodes: Iterable[str]) -> None:
    """Have systemd close everything at the end of a unit with FileDescriptorStorePreserve=yes.

    nodes: those with pipes. systemd would keep the unit as long as the descriptors.
    """
    for name in (*(PREFIX + node for node in nodes), PREFIX, LIFE, RING):
        _forget(name)


def _send(text: str, fds: list[int]) -> None:
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return
    address = "\0" + path[1:] if path.startswith("@") else path
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.connect(address)
        socket.send_fds(sock, [text.encode()], fds)
