"""What a member begins with: a connection in its standard input."""

import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.wire import Part, format_message
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon
from dora_systemd.runner.machines.boot import MemberBoot


@contextmanager
def standard_input(*said: bytes, is_given: bool = True) -> Iterator[None]:
    """With a connection in it, in which somebody has said something."""
    old = os.dup(0)
    own, theirs = socket.socketpair()
    giving, stdin = socket.socketpair()
    own.sendall(b"".join(said))
    if is_given:
        socket.send_fds(giving, [b"\n"], [theirs.fileno()])
    os.dup2(stdin.fileno(), 0)
    try:
        yield
    finally:
        os.dup2(old, 0)
        os.close(old)
        for one in (own, theirs, giving, stdin):
            one.close()


class QuietBoot(MemberBoot):
    """Starts no daemon, and keeps what one would have been told."""

    started: Mapping[str, Any] = {}

    def _spawn_daemon(self) -> Daemon:
        self.started = {"port": self._port, **self._environment}
        raise OSError


def told_boot(options: RunnerOptions, root: Path, part: Part) -> QuietBoot:
    """The boot of a member whose head has said its part. Its connection is closed."""
    with standard_input(format_message(part)):
        boot = QuietBoot(options, CellPaths(root), root, {})
    boot.connection.close()
    return boot
