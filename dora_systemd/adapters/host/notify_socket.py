"""A notify socket as service managers have it: receives messages of sd_notify(3).

Each message comes with its sender, as the kernel knows it: SO_PASSCRED and SCM_CREDENTIALS, see
unix(7). SO_PASSPIDFD, since Linux 6.5, adds a pidfd, by which a process that has exited is not
taken for the next one with its pid.
"""

import contextlib
import os
import signal
import socket
import struct
from pathlib import Path

from dora_systemd.decisions.watchdog.messages import MAX_BYTES
from dora_systemd.errors import bad_input

MAX_PATH = 107
"""Bytes of an address, see unix(7); the nodes get it in NOTIFY_SOCKET, so it is absolute."""
_SO_PASSPIDFD = 76
_SCM_PIDFD = 4
_CREDENTIALS = struct.Struct("iII")
_FD = struct.Struct("i")
# Of file descriptors, only the one of BARRIER=1 is expected: the kernel closes all others.
_ROOM = sum(map(socket.CMSG_SPACE, (_CREDENTIALS.size, _FD.size, _FD.size)))


class NotifySocket:
    """A socket at `path`, mode 0600. Raises OSError, and DoraSystemdError for too long a path."""

    def __init__(self, path: Path) -> None:
        self._path = path
        if len(os.fsencode(path)) > MAX_PATH:
            message = f"cannot make the notify socket {path}: a path has at most {MAX_PATH} bytes"
            raise bad_input(message, "give the dataflow a shorter --name, or the node a shorter id")
        path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_PASSPIDFD, 1)
            self._socket.bind(str(path))
            path.chmod(0o600)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """The descriptor, which is readable when a message waits."""
        return self._socket.fileno()

    def receive(self) -> "Pending | None":
        """The next message, or None. Raises OSError."""
        try:
            data, control, flags, _ = self._socket.recvmsg(
                MAX_BYTES, _ROOM, socket.MSG_CMSG_CLOEXEC
            )
        except BlockingIOError:
            return None
        return Pending(b"" if flags & socket.MSG_TRUNC else data, control)

    def close(self) -> None:
        """Close and remove it."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


class Pending:
    """A message whose sender may wait until the context is left, see sd_notify_barrier(3).

    data: b"" for a message that was too long. pid: of the sender, 0 for an unknown one.
    """

    def __init__(self, data: bytes, control: list[tuple[int, int, bytes]]) -> None:
        self.data = data
        self.pid = 0
        self._pidfd: int | None = None
        self._open: list[int] = []
        for _, kind, value in control:
            self._take(kind, value)

    def _take(self, kind: int, value: bytes) -> None:
        if kind == socket.SCM_CREDENTIALS and len(value) == _CREDENTIALS.size:
            self.pid = _CREDENTIALS.unpack(value)[0]
        elif kind in (_SCM_PIDFD, socket.SCM_RIGHTS):
            whole = value[: len(value) // _FD.size * _FD.size]
            fds = [fd for (fd,) in _FD.iter_unpack(whole)]
            self._open += [fd for fd in fds if fd >= 0]
            if kind == _SCM_PIDFD:
                self._pidfd = fds[0] if fds else -1

    def is_there(self) -> bool:
        """Whether `pid` still is the sender. Call this after all else about it was read."""
        if self._pidfd is None:  # an older kernel sends no pidfd
            return self.pid > 0
        if self._pidfd < 0:
            return False
        try:
            signal.pidfd_send_signal(self._pidfd, 0)
        except OSError as error:
            # EPERM: of another user. EINVAL: of a PID namespace that is not below ours.
            if isinstance(error, ProcessLookupError):
                return False
        return self.pid > 0

    def __enter__(self) -> "Pending":
        return self

    def __exit__(self, *_: object) -> None:
        for fd in self._open:
            with contextlib.suppress(OSError):
                os.close(fd)
        self._open.clear()
