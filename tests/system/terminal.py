"""Programs on a terminal of their own, and what they show there."""

import fcntl
import os
import pty
import re
import select
import shlex
import struct
import subprocess
import termios
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from tests.lab.pace import bound
from tests.system.cells import run


def on_terminal(command: list[str], **environment: str) -> tuple[int, int]:
    """Start a program on a terminal of its own; its pid, and our end of the terminal."""
    pid, fd = pty.fork()
    if not pid:
        os.environ |= environment
        os.execvp(command[0], command)
    return pid, fd


def read_until(fd: int, is_done: Callable[[str], bool]) -> str:
    """The output of a terminal up to where `is_done` says of all of it that it is enough."""
    deadline, seen = time.monotonic() + bound(30), b""
    while not is_done(seen.decode()):
        assert select.select([fd], [], [], deadline - time.monotonic())[0], seen
        seen += os.read(fd, 65536)
    return seen.decode()


def shown(*command: str, **environment: str) -> str:
    """What a command that succeeds shows on a terminal, whatever this process runs on."""
    env = {**os.environ, "TERM": "xterm", **environment}
    return run("script", "-qec", shlex.join(command), "/dev/null", env=env).stdout


class Screen:
    """A terminal of 80 columns with a command in its foreground, as a person has it."""

    def __init__(self, command: list[str]) -> None:
        self._ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
        # In a session of its own, whose terminal this is.
        own = ["setsid", "--ctty", "--wait", *command]
        self.child = subprocess.Popen(own, stdin=theirs, stdout=theirs, stderr=theirs)
        os.close(theirs)
        self._pieces: list[bytes] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self.pause = 0.0
        self._thread.start()

    def _read(self) -> None:
        with suppress(OSError):  # the last end of the other side is closed
            while data := os.read(self._ours, 1024):
                self._pieces.append(data)
                time.sleep(self.pause)

    def press(self, key: bytes) -> None:
        os.write(self._ours, key)

    def end(self) -> int:
        """The exit status, when all of the output is there."""
        self.pause = 0.0
        status = self.child.wait(bound(60))
        self._thread.join(bound(10))
        return status

    def lines(self) -> list[str]:
        """What stays on the screen."""
        text = b"".join(self._pieces).decode().replace("\r\n", "\n")
        lines = (line.rpartition("\r\x1b[K")[2] for line in text.split("\n"))
        return [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in lines if line]
