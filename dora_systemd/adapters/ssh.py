"""Starts ssh(1), as the caller and with the caller's keys and configuration."""

import os
import select
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import check_program

_MOST_BYTES = 1 << 16
"""Bytes kept of the end of ssh's messages."""


def start_ssh(arguments: Sequence[str], **streams: Any) -> "subprocess.Popen[bytes]":
    """Start ssh. streams: as for subprocess.Popen().

    Raises DoraSystemdError: NO_HOST if there is no ssh, NO_PERMISSION if root would run another
    user's.
    """
    check_program("ssh")
    try:
        return subprocess.Popen(["ssh", *arguments], **streams)
    except OSError as error:
        message = f"cannot execute ssh: {error.strerror}"
        raise DoraSystemdError(message, "apt install openssh-client", ExitCode.NO_HOST) from error


def start_here(command: str, **streams: Any) -> "subprocess.Popen[bytes]":
    """The command of a login shell, on this machine. streams: as for subprocess.Popen()."""
    # This doractl need not be one that a login shell would find.
    path = f"{os.environ.get('PATH', os.defpath)}:{Path(sys.executable).parent}"
    check_program("sh")
    return subprocess.Popen(["sh", "-c", command], env={**os.environ, "PATH": path}, **streams)


def read_now(fd: int, size: int = 1 << 16) -> bytes | None:
    """Read what is available without waiting; b"" at the end, None if there is nothing now."""
    with suppress(BlockingIOError):
        return os.read(fd, size)
    return None


def run_on_terminal(arguments: Sequence[str]) -> tuple[int, str]:
    """Run ssh on the terminal of this process; return its exit status and its own messages.

    Standard error has only ssh's messages: the command on the host has a terminal, and so writes
    everything to standard output.
    """
    read, write = os.pipe()
    os.set_blocking(read, False)
    try:
        with start_ssh(arguments, stderr=write) as child:
            said = _hear(child.pid, read)
            status = child.wait()
        # Not to the end of the file: a shared connection, see ControlPersist in ssh_config(5),
        # outlasts ssh and keeps the pipe open.
        return status, (said + (read_now(read) or b"")).decode("utf-8", "replace")
    finally:
        os.close(read)
        os.close(write)


def _hear(pid: int, read: int) -> bytes:
    """Read a pipe until a process ends, which a full pipe would block; return the last bytes."""
    said, ended = b"", os.pidfd_open(pid)
    try:
        while ended not in select.select([ended, read], [], [])[0]:
            said = (said + (read_now(read) or b""))[-_MOST_BYTES:]
    finally:
        os.close(ended)
    return said


class Connection:
    """A running ssh whose output is read without waiting.

    is_fed: ssh reads our standard input; else write() feeds its input, which stays open until
    hang_up(). is_here: no ssh, but the last of `arguments` runs on this machine.
    """

    def __init__(
        self, arguments: Sequence[str], is_fed: bool = False, is_here: bool = False
    ) -> None:
        # In its own process group: Ctrl+C reaches only doractl, which then reports what ends.
        start = partial(start_here, arguments[-1]) if is_here else partial(start_ssh, arguments)
        self._child = start(
            stdin=None if is_fed else subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
        )
        assert self._child.stdout and self._child.stderr
        self.output = self._child.stdout.fileno()
        self.errors = self._child.stderr.fileno()
        self._input = self._child.stdin
        for stream in (self._child.stdout, self._child.stderr, self._input):
            if stream:
                os.set_blocking(stream.fileno(), False)
        self.ended = os.pidfd_open(self._child.pid)

    def read(self, fd: int) -> bytes | None:
        """Read from a stream as read_now() does."""
        return read_now(fd)

    @property
    def input(self) -> int:
        """The file descriptor to write to; -1 for none."""
        return self._input.fileno() if self._input and not self._input.closed else -1

    def write(self, data: bytes) -> int:
        """Write without waiting; return the number of bytes. Raises OSError after ssh has ended."""
        with suppress(BlockingIOError):
            return os.write(self.input, data)
        return 0

    def hang_up(self) -> None:
        """Close the input, so that a following command on the host ends after its last output."""
        if self._input:
            with suppress(OSError):
                self._input.close()

    def close(self) -> int:
        """Kill ssh, if it still runs; return its exit status, negative for a signal."""
        self._child.kill()
        with self._child:
            status = self._child.wait()
        if self.ended >= 0:
            os.close(self.ended)
            self.ended = -1
        return status
