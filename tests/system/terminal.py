"""Programs on a terminal of their own, and what they show there."""

import fcntl
import itertools
import os
import re
import shlex
import struct
import subprocess
import termios
import threading
import time
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from tests.lab.pace import bound
from tests.system.cells import run, wait_for

_NUMBERS = itertools.count()


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


class Tmux(AbstractContextManager["Tmux"]):
    """A shell in tmux(1), which knows what stays on the screen, as a person sees it."""

    def __init__(self, columns: int, rows: int) -> None:
        # Not the name of an earlier one: that server may just be ending, and takes this one along.
        name = f"test-{os.getpid()}-{next(_NUMBERS)}"
        self._server = ["tmux", "-L", name, "-f", "/dev/null"]
        size = ("-x", str(columns), "-y", str(rows))
        shell = "env PS1='% ' HISTFILE= bash --norc --noprofile -i"
        self._tmux("new-session", "-d", *size, shell)
        self.wait_prompt()

    def __exit__(self, *_exception: object) -> None:
        self._tmux("kill-server")

    def _tmux(self, *arguments: str) -> str:
        return run(*self._server, *arguments).stdout

    def press(self, *keys: str) -> None:
        """Keys by their names in tmux, such as Down, PPage, C-z, or a text."""
        self._tmux("send-keys", *keys)

    def resize(self, columns: int, rows: int) -> None:
        """Return once the program can see the new size: tmux may drop the first of two at once."""
        self._tmux("resize-window", "-x", str(columns), "-y", str(rows))
        with Path(self._tmux("display-message", "-p", "#{pane_tty}").strip()).open() as tty:
            wait_for("the size", lambda: os.get_terminal_size(tty.fileno()) == (columns, rows))

    def lines(self) -> list[str]:
        """The lines of the screen, without blanks at their ends."""
        return [line.rstrip() for line in self._tmux("capture-pane", "-p").split("\n")][:-1]

    def wait(self, text: str, *, seconds: float = 30) -> list[str]:
        """The lines, once `text` is somewhere in them."""
        wait_for(text, lambda: text in "\n".join(self.lines()), seconds)
        return self.lines()

    def wait_prompt(self) -> list[str]:
        """The lines that are not empty, once the shell is ready for a command."""
        wait_for("a prompt", lambda: [*filter(None, self.lines())][-1:] == ["%"])
        return [*filter(None, self.lines())]
