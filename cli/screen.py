"""Redraws the whole terminal, and restores it at the end.

The sequences are those of xterm, see console_codes(4); the settings those of termios(3).
"""

import os
import select
import shutil
import signal
import sys
import termios
import tty
from collections.abc import Iterable
from types import FrameType
from typing import TextIO

from dora_systemd.terminal_text import one_line

_ENTER = "\x1b[?1049h\x1b[?25l"
_LEAVE = "\x1b[?25h\x1b[?1049l"
_HOME = "\x1b[H"
_CLEAR_LINE, _CLEAR_BELOW = "\x1b[K", "\x1b[J"
_BOLD, _PLAIN = "\x1b[1m", "\x1b[0m"

_ENDINGS = (signal.SIGTERM, signal.SIGHUP)


class Screen:
    """The terminal of this process, during the `with` block.

    It is also restored when a signal terminates or stops the process.
    """

    def __init__(self, stream: TextIO = sys.stdout) -> None:
        stream.flush()
        # Not the stream: a signal handler must not write to it during another write.
        self._terminal = stream.fileno()
        self._keys = sys.stdin.fileno()
        self._is_entered = False
        # A signal, for example for a new window size, interrupts wait_key().
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def __enter__(self) -> "Screen":
        self._settings = termios.tcgetattr(self._keys)
        for number in _ENDINGS:
            signal.signal(number, self._end)
        signal.signal(signal.SIGTSTP, self._suspend)
        signal.signal(signal.SIGWINCH, lambda _number, _frame: None)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        self._take()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._give_back()
        signal.set_wakeup_fd(-1)
        for number in (*_ENDINGS, signal.SIGTSTP, signal.SIGWINCH):
            signal.signal(number, signal.SIG_DFL)
        os.close(self._woken)
        os.close(self._wake)

    def show(self, lines: Iterable[str], bold: Iterable[int] = ()) -> None:
        """Draw as many and as much of `lines` as there is room for. bold: indices of bold lines."""
        columns, rows = shutil.get_terminal_size()
        shown = list(lines)
        if len(shown) > rows:
            shown = [*shown[: rows - 1], f"... {len(shown) - rows + 1} more lines"]
        emphasized = frozenset(bold)
        drawn = (_drawn(line, columns, at in emphasized) for at, line in enumerate(shown))
        self._write(f"{_HOME}{(_CLEAR_LINE + chr(13) + chr(10)).join(drawn)}{_CLEAR_BELOW}")

    def wait_key(self, seconds: float) -> str:
        """The key pressed within `seconds`; "" without a key or after a signal."""
        ready, _, _ = select.select([self._keys, self._woken], [], [], max(seconds, 0.0))
        if self._woken in ready:
            os.read(self._woken, 512)
        if self._keys not in ready:
            return ""
        # No data means that the terminal is gone.
        return os.read(self._keys, 32).decode("ascii", "replace")[:1] or "q"

    def _take(self) -> None:
        tty.setcbreak(self._keys)
        self._is_entered = True
        self._write(_ENTER)

    def _give_back(self) -> None:
        if self._is_entered:
            self._is_entered = False
            self._write(_LEAVE)
            termios.tcsetattr(self._keys, termios.TCSADRAIN, self._settings)

    def _end(self, number: int, _frame: FrameType | None) -> None:
        try:
            self._give_back()
        finally:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    def _suspend(self, _number: int, _frame: FrameType | None) -> None:
        self._give_back()
        os.kill(os.getpid(), signal.SIGSTOP)
        self._take()

    def _write(self, text: str) -> None:
        data = text.encode()
        while data:
            data = data[os.write(self._terminal, data) :]


def _drawn(line: str, columns: int, is_bold: bool) -> str:
    text = one_line(line)[:columns]
    return f"{_BOLD}{text}{_PLAIN}" if is_bold else text
