"""Runs another user's program on a pseudoterminal instead of root's terminal.

A process with a terminal open can insert input into it, TIOCSTI in ioctl_tty(2), which root's shell
would run. It could also keep reading from it after root believes that the program has ended. So the
program gets its own session and pseudoterminal, and run_apart() copies between the two. What the
program prints is escaped on the way, see Display: it cannot make root's terminal type something.
"""

import contextlib
import fcntl
import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator, Mapping, Sequence
from types import FrameType
from typing import Any, NoReturn

from dora_systemd.errors import ExitCode
from dora_systemd.terminal_text import Display
from dora_systemd.trust.programs import Account, become

_CHUNK = 65536
_MOST_LATE = 64
"""Chunks to show after the program has ended: its children may keep writing."""
_STREAMS = range(3)
_MODES = 3
"""The place of the local modes in what tcgetattr() returns, see termios(3)."""
_BY_SIGNAL = 128


def run_apart(command: Sequence[str], environment: Mapping[str, str], account: Account) -> int:
    """Run a program as `account` until it exits; its exit status, or 128 + signal.

    Its standard streams are the caller's, except for those that are a terminal. Raises OSError.
    """
    screen = next((fd for fd in (1, 2, 0) if os.isatty(fd)), None)
    mode = termios.tcgetattr(0) if os.isatty(0) else None
    ours, theirs = os.openpty()
    # Before the program starts, which may read both at once.
    _copy_size(screen, ours)
    if mode is not None:
        termios.tcsetattr(ours, termios.TCSANOW, mode)
    child = os.fork()
    if child == 0:
        _become_program(command, environment, account, theirs)
    os.close(theirs)
    try:
        with _woken() as wake, _carried(child, ours, screen, mode):
            _carry(child, ours, screen, wake)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    finally:
        os.close(ours)
    return status if status >= 0 else _BY_SIGNAL - status


def _become_program(
    command: Sequence[str], environment: Mapping[str, str], account: Account, terminal: int
) -> NoReturn:
    try:
        os.setsid()
        fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
        for fd in _STREAMS:
            if os.isatty(fd):
                os.dup2(terminal, fd)
        become(account)
        os.execve(command[0], list(command), dict(environment))
    except OSError as error:
        print(f"doractl: cannot run {command[0]}: {error.strerror}", file=sys.stderr, flush=True)
    finally:
        os._exit(ExitCode.NO_DORA)


@contextlib.contextmanager
def _woken() -> Iterator[int]:
    """A descriptor that is readable after each signal.

    Python handles a signal that comes just before select(2) only after that has returned.
    """
    wake, waker = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    before = signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    try:
        yield wake
    finally:
        signal.set_wakeup_fd(before)
        os.close(wake)
        os.close(waker)


@contextlib.contextmanager
def _carried(child: int, ours: int, screen: int | None, mode: list[Any] | None) -> Iterator[None]:
    """Set our terminal to raw mode, and pass on its size and our signals.

    mode: that of our terminal, or None without one.
    """

    def hand_on(number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGWINCH:
            _copy_size(screen, ours)
        else:
            os.kill(child, number)

    numbers = (signal.SIGWINCH, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, hand_on) for number in numbers}
    _copy_size(screen, ours)
    try:
        if mode is not None:
            tty.setraw(0)
        yield
    finally:
        if mode is not None:
            termios.tcsetattr(0, termios.TCSADRAIN, mode)
        for number, handler in before.items():
            signal.signal(number, handler)


def _copy_size(screen: int | None, ours: int) -> None:
    if screen is not None:
        with contextlib.suppress(OSError):
            fcntl.ioctl(ours, termios.TIOCSWINSZ, fcntl.ioctl(screen, termios.TIOCGWINSZ, bytes(8)))


def _carry(child: int, ours: int, screen: int | None, wake: int) -> None:
    """Copy input and output until the program has ended."""
    end, display = os.pidfd_open(child), Display()
    sources = [end, ours, wake, *([0] if os.isatty(0) else [])]
    try:
        while end not in (ready := select.select(sources, [], [])[0]):
            if wake in ready:
                os.read(wake, _CHUNK)
            if ours in ready and not _show(ours, screen, display):
                sources.remove(ours)
            if 0 in ready and not _copy(0, ours):
                sources.remove(0)
        for _ in range(_MOST_LATE):
            if not (select.select([ours], [], [], 0)[0] and _show(ours, screen, display)):
                return
    finally:
        os.close(end)
        _write(screen, display.end())


def _copy(source: int, target: int) -> bool:
    """Copy one chunk; False at the end, which a pseudoterminal reports as an error."""
    data = _read(source)
    return bool(data) and _write(target, data)


def _show(ours: int, screen: int | None, display: Display) -> bool:
    """Copy one chunk for a terminal; False at the end."""
    data = _read(ours)
    # A program without line input uses the whole screen. It may end that before we read the rest.
    display.is_full |= bool(data) and not termios.tcgetattr(ours)[_MODES] & termios.ICANON
    return bool(data) and _write(screen, display.show(data))


def _read(source: int) -> bytes:
    with contextlib.suppress(OSError):
        return os.read(source, _CHUNK)
    return b""


def _write(target: int | None, data: bytes) -> bool:
    try:
        while data and target is not None:
            data = data[os.write(target, data) :]
    except OSError:
        return False
    return True
