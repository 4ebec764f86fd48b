"""An ssh in the background: what comes from it, without waiting, and its end."""

import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from functools import partial

from dora_systemd.adapters.ssh.program import read_now, start_here, start_ssh


class Connection:
    """A running ssh whose output is read when it is there.

    is_fed: it reads our standard input; else its input is what write() gets, and stays open until
    hang_up(). is_here: no ssh, but the last of `arguments` on this machine.
    """

    def __init__(
        self, arguments: Sequence[str], is_fed: bool = False, is_here: bool = False
    ) -> None:
        # In a process group of its own: Ctrl+C is for doractl, which then says what ends.
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
        """As read_now()."""
        return read_now(fd)

    @property
    def input(self) -> int:
        """The file descriptor to write to; -1 for none."""
        return self._input.fileno() if self._input and not self._input.closed else -1

    def write(self, data: bytes) -> int:
        """Write as much as goes now; the number of bytes. Raises OSError if nobody reads it."""
        with suppress(BlockingIOError):
            return os.write(self.input, data)
        return 0

    def hang_up(self) -> None:
        """End the input: what follows over there then ends, and says its last words."""
        if self._input:
            with suppress(OSError):
                self._input.close()

    def close(self) -> int:
        """End it, if it has not ended; its exit status, negative for a signal."""
        self._child.kill()
        with self._child:
            status = self._child.wait()
        if self.ended >= 0:
            os.close(self.ended)
            self.ended = -1
        return status
