"""systemd's file descriptor store: what outlives the runner.

While systemd holds a pipe open, what is in it stays there. See FDSTORE=1 in sd_notify(3) and
FileDescriptorStoreMax= in systemd.service(5).
"""

import contextlib
import os
import socket

PREFIX = "dora-log-"
"""What we keep is named after its node, so that it can go with it."""
LIFE = "dora-life"
"""One such descriptor for each life of the runner since the last quiet window."""
_MOST_LIVES = 64
_FIRST = 3  # SD_LISTEN_FDS_START, see sd_listen_fds(3)


def store(fd: int, node: str) -> None:
    """Have systemd keep `fd` open too; without systemd, or a store, nothing happens."""
    _send(f"FDSTORE=1\nFDNAME={PREFIX}{node}\nFDPOLL=0", [fd])


def forget(node: str) -> None:
    """Have systemd close what it keeps of a node that is gone for good."""
    _forget(PREFIX + node)


def _forget(name: str) -> None:
    _send(f"FDSTOREREMOVE=1\nFDNAME={name}", [])


def lives() -> int:
    """How many lives came before this one with no quiet window between them, _MOST_LIVES at most.

    systemd keeps the count from one restart to the next, and forgets it when the unit is stopped.
    `systemd-analyze fdstore` shows it.
    """
    if os.environ.get("LISTEN_PID", "") != str(os.getpid()):
        return 0
    return os.environ.get("LISTEN_FDNAMES", "").split(":").count(LIFE)


def count_life() -> None:
    """This life is one more."""
    if lives() < _MOST_LIVES:
        # Of its own: systemd keeps what it has already only once.
        fd = os.memfd_create(LIFE, os.MFD_CLOEXEC)
        _send(f"FDSTORE=1\nFDNAME={LIFE}\nFDPOLL=0", [fd])
        os.close(fd)


def forget_lives() -> None:
    """This life is the first one."""
    _forget(LIFE)
    count_life()


def forget_inherited() -> None:
    """Close what an earlier life of this process left in the store, and take it out of it."""
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


def _send(text: str, fds: list[int]) -> None:
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return
    address = "\0" + path[1:] if path.startswith("@") else path
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.connect(address)
        socket.send_fds(sock, [text.encode()], fds)
