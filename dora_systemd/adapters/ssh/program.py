"""Starts ssh(1), as the caller and with the caller's keys and configuration."""

import os
import select
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import check_program

_MOST_BYTES = 1 << 16
"""Of what ssh has said, the last."""


def start_ssh(arguments: Sequence[str], **streams: Any) -> "subprocess.Popen[bytes]":
    """A running ssh. streams: as for subprocess.Popen().

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
    """What can be read without waiting; b"" at the end, None if there is nothing now."""
    with suppress(BlockingIOError):
        return os.read(fd, size)
    return None


def run_on_terminal(arguments: Sequence[str]) -> tuple[int, str]:
    """Run ssh on the terminal of this process; its exit status, and what it has said itself.

    What the host says comes by standard output, because it has a terminal there.
    """
    read, write = os.pipe()
    os.set_blocking(read, False)
    try:
        with start_ssh(arguments, stderr=write) as child:
            said = _hear(child.pid, read)
            status = child.wait()
        # Not to the end of the file: a connection that is shared, ControlPersist in ssh_config(5),
        # goes on and keeps it open.
        return status, (said + (read_now(read) or b"")).decode("utf-8", "replace")
    finally:
        os.close(read)
        os.close(write)


def _hear(pid: int, read: int) -> bytes:
    """The last that is written to a pipe until a process ends: a full pipe would hold it up."""
    said, ended = b"", os.pidfd_open(pid)
    try:
        while ended not in select.select([ended, read], [], [])[0]:
            said = (said + (read_now(read) or b""))[-_MOST_BYTES:]
    finally:
        os.close(ended)
    return said
