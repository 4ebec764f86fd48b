"""What run_apart() does with the terminal and the signals of its caller."""

import contextlib
import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.terminals import run_apart

SIZE = (33, 77)
OURS = (signal.SIGWINCH, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# A person at the terminal: reads until each text is there, and does then what belongs to it.
PERSON = """
import fcntl, os, select, struct, sys, termios
master, seen = int(sys.argv[1]), b""
steps = [one.split("=", 1) for one in sys.argv[2:]]
while True:
    if steps and steps[0][0].encode() in seen:
        action, _, value = steps.pop(0)[1].partition(":")
        if action == "type":
            os.write(master, value.encode().decode("unicode_escape").encode())
        elif action == "size":
            size = struct.pack("HHHH", *map(int, value.split("x")), 0, 0)
            fcntl.ioctl(master, termios.TIOCSWINSZ, size)
            os.kill(os.getppid(), 28)
        else:
            os.kill(os.getppid(), int(value))
        continue
    ready = select.select([master, 0], [], [], 30)[0]
    if master in ready:
        seen += os.read(master, 65536)
    elif 0 in ready or not ready:  # nobody holds the other end of this pipe any more
        break
sys.stdout.buffer.write(seen)
"""


class Shown(NamedTuple):
    """What a person saw, and how the program ended."""

    text: str
    status: int


def size_of(fd: int) -> tuple[int, int]:
    rows, columns, _, _ = struct.unpack("HHHH", fcntl.ioctl(fd, termios.TIOCGWINSZ, bytes(8)))
    return rows, columns


@contextlib.contextmanager
def instead(fds: tuple[int, ...], other: int) -> Iterator[None]:
    """`other` in the place of these file descriptors."""
    kept = {fd: os.dup(fd) for fd in fds}
    try:
        for fd in fds:
            os.dup2(other, fd)
        yield
    finally:
        for fd, own in kept.items():
            os.dup2(own, fd)
            os.close(own)


def at_a_terminal(script: str, *steps: str, fds: tuple[int, ...] = (0, 1, 2)) -> Shown:
    """Run `script` apart while a terminal is in the place of `fds`. steps: of the person there."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", *SIZE, 0, 0))
    command = (sys.executable, "-c", PERSON, str(master), *steps)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, pass_fds=[master]) as person:
        environment = {"PATH": os.defpath, "PYTHONUNBUFFERED": "1", "MINE": "yes"}
        words = (sys.executable, "-c", script, "first", "second")
        with instead(fds, slave):
            status = run_apart(words, environment, own_account())
        text = person.communicate()[0].decode()
    os.close(master)
    os.close(slave)
    return Shown(text, status)


def test_a_program_gets_exactly_what_it_is_given() -> None:
    script = "import os, sys\nprint(sys.argv[1:], sorted(os.environ))\nsys.exit(0)"
    shown = at_a_terminal(script)
    assert shown.status == 0
    assert "['first', 'second'] [" in shown.text
    assert "'MINE'" in shown.text
    assert "HOME" not in shown.text


def test_it_is_typed_to_and_its_terminal_is_its_own() -> None:
    script = """
import os, sys
word = input("ask ")
print("got", word, os.getsid(0) == os.getpid() == os.tcgetpgrp(0))
print(all(os.isatty(fd) and os.ttyname(fd) == os.ttyname(0) for fd in range(3)))
print("tty", os.ttyname(0))
"""
    shown = at_a_terminal(script, "ask =type:word\\n")
    assert "got word True\r\nTrue\r\n" in shown.text
    assert shown.status == 0


def test_much_is_shown_whole() -> None:
    """Also what comes just before the end."""
    shown = at_a_terminal("import os\nfor n in range(20000): print(n)\nos._exit(3)")
    assert shown.status == 3
    assert shown.text.split() == [str(n) for n in range(20000)]


def test_a_key_is_no_signal_to_us() -> None:
    """Raw mode: the program's own terminal makes a signal of Ctrl+C."""
    script = """
import signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # pause() would miss an early one
print("go", flush=True)
signal.sigwait({signal.SIGINT})
sys.exit(9)
"""
    assert at_a_terminal(script, "go=type:\\x03").status == 9


def test_the_size_of_the_terminal_is_handed_on() -> None:
    script = """
import os, signal
print("size", *os.get_terminal_size(0), flush=True)
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGWINCH})  # pause() would miss an early one
print("go", flush=True)
signal.sigwait({signal.SIGWINCH})
print("size", *os.get_terminal_size(0), flush=True)
"""
    shown = at_a_terminal(script, "go=size:11x99")
    assert [line for line in shown.text.splitlines() if line.startswith("size")] == [
        "size 77 33",
        "size 99 11",
    ]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_us_is_one_to_the_program(number: signal.Signals) -> None:
    # nohup(1), or a shell that starts this in the background, has it ignored.
    default = f"signal.signal({number.value}, signal.SIG_DFL)"
    script = f"import signal\n{default}\nprint('go')\nsignal.pause()"
    assert at_a_terminal(script, f"go=kill:{number.value}").status == 128 + number


def test_all_is_as_before() -> None:
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", *SIZE, 0, 0))
    mode = termios.tcgetattr(slave)
    handlers = [signal.getsignal(one) for one in OURS]
    opened = sorted(path.name for path in Path("/proc/self/fd").iterdir())
    with instead((0, 1, 2), slave):
        assert run_apart(("/bin/true",), {}, own_account()) == 0
    assert termios.tcgetattr(slave) == mode
    assert size_of(slave) == SIZE
    assert [signal.getsignal(one) for one in OURS] == handlers
    assert sorted(path.name for path in Path("/proc/self/fd").iterdir()) == opened
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)
    os.close(master)
    os.close(slave)


def test_the_mode_of_our_terminal_is_that_of_the_program() -> None:
    """As after `stty -echo`."""
    script = "import termios\nprint('echo', bool(termios.tcgetattr(0)[3] & termios.ECHO))"
    master, slave = pty.openpty()
    mode = termios.tcgetattr(slave)
    mode[3] &= ~termios.ECHO
    termios.tcsetattr(slave, termios.TCSANOW, mode)
    words = (sys.executable, "-c", script)
    with instead((0, 1, 2), slave):
        assert run_apart(words, {"PATH": os.defpath}, own_account()) == 0
    assert os.read(master, 1000) == b"echo False\r\n"
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("fds", [(0,), (1,), (0, 1), (2,)])
def test_only_what_was_a_terminal_is_one(
    fds: tuple[int, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    script = """
import os, sys
ttys = [fd for fd in range(3) if os.isatty(fd)]
os.write(ttys[0], f"ttys {ttys} {os.get_terminal_size(ttys[0])[:]}\\n".encode())
"""
    with Path("/dev/null").open("rb") as null, instead((0,), null.fileno()):
        shown = at_a_terminal(script, fds=fds)
    assert f"ttys {list(fds)} (77, 33)\r" in shown.text
    assert shown.status == 0
    assert capfd.readouterr().err == ""


def test_what_cannot_be_executed(capfd: pytest.CaptureFixture[str]) -> None:
    status = run_apart(("/nowhere/dora",), {}, own_account())
    assert status == ExitCode.NO_DORA
    said = "doractl: cannot run /nowhere/dora: No such file or directory\n"
    assert capfd.readouterr().err == said
