"""The terminal of `doractl top` on a real pseudo terminal: drawn, and left as it was."""

import os
import pty
import select
import signal
import sys
import termios
import time
from pathlib import Path

import pytest

SCRIPT = """
import sys
from dora_systemd.cli.screen import Screen
with Screen() as screen:
    while True:
        screen.show(["first", "second\\x1b[31m", *["more"] * 99], bold=[0])
        key = screen.wait_key(30)
        if key == "q":
            break
"""
WIDE = """
from dora_systemd.cli.screen import Screen
with Screen() as screen:
    screen.show(["x" * 100000] * 4)
    screen.wait_key(30)
"""
ENTER, LEAVE = b"\x1b[?1049h", b"\x1b[?1049l"


class Terminal:
    """A program on a terminal of its own."""

    def __init__(self, script: str, **environment: str) -> None:
        self.pid, self.fd = pty.fork()
        if not self.pid:
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
                signal.signal(number, signal.SIG_DFL)  # a shell's background job ignores some
            environment = {**os.environ, "LINES": "8", **environment}
            os.execve(sys.executable, [sys.executable, "-c", script], environment)
        self.before = termios.tcgetattr(self.fd)
        self.seen = b""

    def wait_for(self, text: bytes) -> None:
        deadline = time.monotonic() + 120
        while text not in self.seen:
            assert select.select([self.fd], [], [], deadline - time.monotonic())[0], self.seen
            self.seen += os.read(self.fd, 65536)

    def wait_asleep(self) -> None:
        deadline = time.monotonic() + 120
        while Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0] != "S":
            assert time.monotonic() < deadline

    def end(self) -> int:
        """The exit status as waitpid has it, after all output was read."""
        _, status = os.waitpid(self.pid, 0)
        while select.select([self.fd], [], [], 0)[0]:
            try:
                data = os.read(self.fd, 65536)
            except OSError:
                break
            if not data:
                break
            self.seen += data
        return status


@pytest.fixture
def terminal() -> Terminal:
    terminal = Terminal(SCRIPT)
    terminal.wait_for(b"more lines")
    return terminal


def test_it_is_drawn_and_left(terminal: Terminal) -> None:
    assert terminal.seen.startswith(ENTER)
    assert b"\x1b[1mfirst\x1b[0m" in terminal.seen
    assert rb"second\x1b[31m" in terminal.seen
    assert b"... 94 more lines" in terminal.seen
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0
    assert terminal.seen.endswith(LEAVE)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_it_clean(terminal: Terminal, number: int) -> None:
    os.kill(terminal.pid, number)
    status = terminal.end()
    assert os.WTERMSIG(status) == number
    assert terminal.seen.endswith(LEAVE)


def test_a_signal_in_the_middle_of_a_drawing() -> None:
    """Nobody reads, so it is still drawing when the signal comes."""
    terminal = Terminal(WIDE, COLUMNS="100000")
    terminal.wait_for(ENTER)
    terminal.wait_asleep()
    os.kill(terminal.pid, signal.SIGTSTP)
    terminal.wait_for(LEAVE)
    _, status = os.waitpid(terminal.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)
    os.kill(terminal.pid, signal.SIGCONT)
    terminal.wait_for(b"x\x1b[J")
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_interrupt(terminal: Terminal) -> None:
    os.write(terminal.fd, b"\x03")
    terminal.end()
    assert LEAVE in terminal.seen


def test_suspended_and_back(terminal: Terminal) -> None:
    os.kill(terminal.pid, signal.SIGTSTP)
    _, status = os.waitpid(terminal.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)
    terminal.wait_for(LEAVE)
    modes = termios.tcgetattr(terminal.fd)
    assert modes[3] == terminal.before[3]
    terminal.seen = b""
    os.kill(terminal.pid, signal.SIGCONT)
    terminal.wait_for(ENTER)
    terminal.wait_for(b"more lines")
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_another_size_is_drawn_at_once(terminal: Terminal) -> None:
    terminal.seen = b""
    os.kill(terminal.pid, signal.SIGWINCH)
    terminal.wait_for(b"more lines")
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0
