"""Starts the dora coordinator and the dora daemon of one cell as child processes."""

import contextlib
import os
import re
import select
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from dora_systemd.adapters.host.process_table import PROC, status_fields
from dora_systemd.decisions.cell.exits import Exit, exit_of

if TYPE_CHECKING:
    import asyncio

LISTENING = "Listening on port "
"""What a coordinator prints before its port, once it has written its token."""
_PORT = rf"(?m)^{LISTENING}(\d+)\n".encode()
_CHUNK = 4096
_FLAGS = 6
"""Field of /proc/PID/stat behind the name, from 0."""
_PF_EXITING = 0x4
"""From include/linux/sched.h of Linux."""


def coordinator_command(dora: str, port: int = 0) -> list[str]:
    """A coordinator on a loopback port that creates its own token and stores nothing.

    port: 0 for one that is free.
    """
    flags = ("--interface", "127.0.0.1", "--port", str(port), "--store", "memory", "--auth")
    return [dora, "coordinator", *flags]


def coordinator_environment(environment: Mapping[str, str], directory: Path) -> dict[str, str]:
    """$XDG_CONFIG_HOME for the token: the token of the user's own dora must not be overwritten."""
    own = {"XDG_CONFIG_HOME": str(directory), "TMPDIR": str(directory), "RUST_BACKTRACE": "0"}
    return {**environment, **own, "NO_COLOR": "1"}


def daemon_command(dora: str, port: int, local_listen_port: int) -> list[str]:
    """A daemon that only connects to its coordinator: cells must not discover each other."""
    coordinator = ("--coordinator-addr", "127.0.0.1", "--coordinator-port", str(port))
    own = ("--local-listen-port", str(local_listen_port), "--zenoh-no-multicast")
    return [dora, "daemon", *coordinator, *own]


def reserved_port() -> socket.socket:
    """A socket that keeps a free TCP port of the loopback interface from all but a daemon.

    The kernel gives such a port to nobody who lets the kernel choose. A daemon of dora can listen
    on it, because it sets SO_REUSEADDR, too, see socket(7). Raises OSError.
    """
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind(("127.0.0.1", 0))
    return held


class Child(NamedTuple):
    """One child process."""

    label: str
    popen: "subprocess.Popen[bytes]"
    pidfd: int
    output: int  # read end of its stdout and stderr
    said: bytearray  # the output so far

    def is_exiting(self) -> bool:
        """Return whether the exit has begun, a moment before the pidfd can be read.

        The kernel sets the flag PF_EXITING before it closes the connections of the process, see
        proc_pid_stat(5).
        """
        if self.popen.returncode is not None:
            return True
        return bool(int(status_fields(PROC / str(self.popen.pid))[_FLAGS]) & _PF_EXITING)

    def send_signal(self, number: signal.Signals) -> None:
        """Send the child a signal, but never another process that has reused its pid."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, number)

    def close(self, loop: "asyncio.AbstractEventLoop", seconds: float) -> None:
        """Reap the child if it exits within `seconds`, and close its file descriptor."""
        # Not popen.wait(seconds), which sleeps up to 50 ms between two looks.
        poll = select.poll()
        poll.register(self.pidfd, select.POLLIN)
        if poll.poll(seconds * 1000):
            self.popen.wait()
        loop.remove_reader(self.pidfd)
        os.close(self.pidfd)


def spawn(
    label: str, command: Sequence[str], environment: Mapping[str, str], directory: Path
) -> Child:
    """Start a child; its output can be read from Child.output. Raises OSError."""
    reading, writing = os.pipe2(os.O_CLOEXEC)
    try:
        popen = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=writing,
            stderr=writing,
            env=environment,
            cwd=directory,
        )
    except OSError:
        os.close(reading)
        raise
    finally:
        os.close(writing)
    return Child(label, popen, os.pidfd_open(popen.pid), reading, bytearray())


def read_port(coordinator: Child, seconds: float) -> int:
    """The port of a coordinator; 0 if it ends, or prints none within `seconds`."""
    deadline = time.monotonic() + seconds
    poll = select.poll()
    poll.register(coordinator.output, select.POLLIN)
    while poll.poll(max(deadline - time.monotonic(), 0) * 1000):
        chunk = os.read(coordinator.output, _CHUNK)
        coordinator.said.extend(chunk)
        found = re.search(_PORT, coordinator.said)
        if found or not chunk:
            return int(found[1]) if found else 0
    return 0


def watch(
    loop: "asyncio.AbstractEventLoop", child: Child, on_exit: Callable[[str, Exit], None]
) -> None:
    """Call on_exit(label, exit) once, after the child has exited."""

    def ended() -> None:
        loop.remove_reader(child.pidfd)
        on_exit(child.label, exit_of(child.popen.wait()))

    loop.add_reader(child.pidfd, ended)
