"""The terminal of `doractl top` on a real pseudo terminal: drawn, and left as it was."""

import fcntl
import os
import re
import select
import signal
import struct
import sys
import termios
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from dora_systemd.cli.screen import Screen, Work
from dora_systemd.decisions.views.top import TopRow
from dora_systemd.decisions.views.top_screen import Change, TopScreen
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

SCRIPT = """
from dora_systemd.cli.screen import open_screen
from dora_systemd.decisions.views.top_screen import Line
with open_screen(want_colors=True) as screen:
    key = ""
    while key != "q":
        columns, rows = screen.size()
        size = Line(f"{columns}x{rows} {key}")
        screen.show([Line("first", "bold"), Line("second\\x1b[31m", "red reverse"), size])
        key = screen.wait_key(30)
"""
WIDE = """
from dora_systemd.cli.screen import open_screen
from dora_systemd.decisions.views.top_screen import Line
with open_screen(want_colors=False) as screen:
    while True:
        columns, rows = screen.size()
        screen.show([Line("x" * columns)] * rows)
        if screen.wait_key(30) == "q":
            break
"""
ENTER, LEAVE = b"\x1b[?1049h", b"\x1b[?1049l"
SIZE = b"60x8"


class Terminal:
    """A program on a terminal of its own.

    Not as the leader of its session: when that one ends, the kernel discards what it has just
    written.
    """

    def __init__(
        self,
        script: str,
        rows: int = 8,
        columns: int = 60,
        has_shell: bool = True,
        **environment: str,
    ) -> None:
        self.fd, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", rows, columns, 0, 0))
        self.pid = os.fork()
        if not self.pid:
            # The kernel stops no program that has nobody to continue it, see setpgid(2).
            os.setpgid(0, 0) if has_shell else os.setsid()
            for stream in range(3):
                os.dup2(theirs, stream)
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
                signal.signal(number, signal.SIG_DFL)  # a shell's background job ignores some
            environment = {**os.environ, "TERM": "xterm", **environment}
            for name in ("LINES", "COLUMNS"):
                environment.pop(name, None)
            os.execve(sys.executable, [sys.executable, "-c", script], environment)
        os.close(theirs)
        self.before = termios.tcgetattr(self.fd)
        self.seen = b""

    def wait_for(self, text: bytes) -> None:
        deadline = time.monotonic() + 60
        while text not in self.seen:
            assert select.select([self.fd], [], [], deadline - time.monotonic())[0], self.seen
            self.seen += os.read(self.fd, 65536)

    def wait_asleep(self) -> None:
        deadline = time.monotonic() + 60
        while Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0] != "S":
            assert time.monotonic() < deadline

    def end(self) -> int:
        """The exit status as waitpid has it, after all output was read."""
        with suppress(OSError):  # the other side is closed
            while data := os.read(self.fd, 65536):
                self.seen += data
        return os.waitpid(self.pid, 0)[1]


@pytest.fixture
def terminal() -> Terminal:
    terminal = Terminal(SCRIPT)
    terminal.wait_for(SIZE)
    return terminal


def test_it_is_drawn_and_left(terminal: Terminal) -> None:
    assert terminal.seen.startswith(ENTER)
    assert b";1mfirst" in terminal.seen
    assert rb"second\x1b[31m" in terminal.seen, "escaped"
    assert re.search(rb"7m(\x1b\[31m)?second", terminal.seen)
    assert b"\x1b[31m" in terminal.seen
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0
    assert LEAVE in terminal.seen
    assert b"\x1b[?25h" in terminal.seen
    assert termios.tcgetattr(terminal.fd)[3] == terminal.before[3]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_signal_leaves_it_clean(terminal: Terminal, number: int) -> None:
    os.kill(terminal.pid, number)
    status = terminal.end()
    assert os.WTERMSIG(status) == number
    assert LEAVE in terminal.seen
    assert termios.tcgetattr(terminal.fd)[3] == terminal.before[3]


def test_a_signal_in_the_middle_of_a_drawing() -> None:
    """Nobody reads, so it is still drawing when the signal comes."""
    terminal = Terminal(WIDE, 200, 500)
    terminal.wait_for(ENTER)
    terminal.wait_asleep()
    os.kill(terminal.pid, signal.SIGTSTP)
    terminal.wait_for(LEAVE)
    _, status = os.waitpid(terminal.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)
    os.kill(terminal.pid, signal.SIGCONT)
    terminal.seen = b""
    terminal.wait_for(b"x\x1b[?7h")  # the last column of the last row
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_interrupt(terminal: Terminal) -> None:
    os.kill(terminal.pid, signal.SIGINT)
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
    terminal.wait_for(SIZE)
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_without_a_shell_it_is_not_suspended() -> None:
    """As by doractl -H: nobody could continue it, and the terminal would take no key."""
    terminal = Terminal(SCRIPT, has_shell=False)
    terminal.wait_for(SIZE)
    os.kill(terminal.pid, signal.SIGTSTP)
    terminal.wait_for(LEAVE)
    os.write(terminal.fd, b"c")
    terminal.wait_for(b"c\r")
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_another_size_is_drawn_at_once(terminal: Terminal) -> None:
    terminal.seen = b""
    fcntl.ioctl(terminal.fd, termios.TIOCSWINSZ, struct.pack("4H", 5, 70, 0, 0))
    os.kill(terminal.pid, signal.SIGWINCH)
    terminal.wait_for(b"70x5")
    assert b"first" in terminal.seen, "the terminal may have moved its lines"
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


@pytest.mark.parametrize(
    ("sent", "name"),
    [
        (b"\x1bOA", b"KEY_UP"),
        (b"\x1b[6~", b"KEY_NPAGE"),
        (b"\x1bOF", b"KEY_END"),
        (b"c", b"c\r"),
        (b"\x1bOB" * 3, b"KEY_DOWN"),
    ],
)
def test_keys_have_names(terminal: Terminal, sent: bytes, name: bytes) -> None:
    os.write(terminal.fd, sent)
    terminal.wait_for(name)
    os.write(terminal.fd, b"q")
    assert terminal.end() == 0


def test_a_terminal_that_goes_away_ends_it(terminal: Terminal) -> None:
    os.close(terminal.fd)
    _, status = os.waitpid(terminal.pid, 0)
    assert status == 0


def test_a_terminal_that_terminfo_does_not_know() -> None:
    terminal = Terminal(SCRIPT, TERM="nosuch", PYTHON_COLORS="0")
    assert terminal.end() != 0
    assert b"DoraSystemdError: cannot use the terminal nosuch" in terminal.seen
    assert ENTER not in terminal.seen


SCOPE = ScopeIn(is_user=True, uid=1000, root=Path("/nowhere"))
ROBOT = TopRow(UUID, "robot", "", "Running", ())


@dataclass
class Woken:
    """The screen as a thread knows it. said: what the view says each time."""

    view: TopScreen
    said: tuple[str, ...] = ()

    def wake(self) -> None:
        self.said += (self.view.said,)


def said_about(change: Change, manager: FakeManager, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    fake_systemd(monkeypatch, manager)
    screen = Woken(TopScreen("cpu"))
    work = Work(SCOPE, change, screen.view, cast(Screen, screen))
    work.start()
    work.join()
    assert work.result == screen.said[-1]
    return list(screen.said)


def test_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    manager.add(options())
    said = said_about(Change("restart", ROBOT), manager, monkeypatch)
    assert said[0] == "Restart robot ..."
    assert said[-1] == f"Dataflow restarted: {UUID} (robot)"


def test_what_has_ended_meanwhile_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stopped = life_record("dataflow-stopped", 1_000_000, scope=SCOPE)
    FakeJournal(monkeypatch, tmp_path).write(stopped)
    said = said_about(Change("stop", ROBOT), FakeManager(), monkeypatch)
    assert said[-1] == "doractl: cannot use the dataflow robot: it has ended"


def test_an_error_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    said = said_about(Change("stop", ROBOT), FakeManager(), monkeypatch)
    assert said[-1].startswith("doractl: no dataflow ")
