"""A child process with pipes. Not subprocess: that takes a megabyte of each link for good."""

import os
import select
import signal
from contextlib import suppress

_SECONDS = 2.0
"""For its end, before it is killed."""


class Program:
    """A running program, looked up in PATH. input, output, errors: our ends of its pipes.

    Leaving its block ends it. Raises OSError if it cannot be executed.
    """

    def __init__(self, name: str, arguments: list[str]) -> None:
        theirs_in, self.input = os.pipe()
        self.output, theirs_out = os.pipe()
        self.errors, theirs_err = os.pipe()
        theirs = (theirs_in, theirs_out, theirs_err)
        try:
            actions = [(os.POSIX_SPAWN_DUP2, fd, number) for number, fd in enumerate(theirs)]
            self._pid = os.posix_spawnp(
                name,
                [name, *arguments],
                os.environ,
                file_actions=actions,
                setsigdef=[signal.SIGPIPE],
            )
        finally:
            for fd in theirs:
                os.close(fd)
        self.ended = os.pidfd_open(self._pid)
        self._status: int | None = None

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        for fd in (self.input, self.output, self.errors, self.ended):
            os.close(fd)

    def end(self) -> int:
        """End it, if it has not ended; its exit status, negative for a signal."""
        if self._status is None:
            if not _waits(self.ended, 0):
                signal.pidfd_send_signal(self.ended, signal.SIGTERM)
            if not _waits(self.ended, _SECONDS):
                signal.pidfd_send_signal(self.ended, signal.SIGKILL)
            self._status = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._status


def read_now(fd: int, size: int = 1 << 16) -> bytes:
    """What can be read without waiting; b"" if there is nothing, or will be nothing more."""
    os.set_blocking(fd, False)
    with suppress(BlockingIOError):
        return os.read(fd, size)
    return b""


def _waits(fd: int, seconds: float) -> bool:
    return bool(select.select([fd], [], [], seconds)[0])
