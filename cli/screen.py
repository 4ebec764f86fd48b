"""`doractl top` on a terminal: draws, reads keys, and makes changes in the background.

The whole terminal is redrawn, and restored at the end.

By curses of the standard library: it knows the sequences of each terminal, decodes its keys, and
writes only what has changed. Its import takes 2 ms and half a megabyte, which only `doractl top`
pays, and it saves the tables of keys and sequences that a screen of our own needs. In return, a
terminal must be one that terminfo(5) knows. Signals are handled here: curses loses a SIGTSTP in the
middle of a drawing, and makes an exit status 1 of SIGTERM.
"""

import curses
import os
import select
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Thread

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.terminal import wants_colors
from dora_systemd.decisions.views.top_screen import Change, Line, TopScreen
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.terminal_text import one_line
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.restart import act_on
from dora_systemd.verbs.top import Top

_ENDINGS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_SIGNALS = (*_ENDINGS, signal.SIGTSTP, signal.SIGCONT, signal.SIGWINCH)
_COLORS = {"red": curses.COLOR_RED, "yellow": curses.COLOR_YELLOW}


class _Ended(Exception):
    """A signal that terminates the process has arrived."""


class Screen:
    """The terminal of this process, during the block of open_screen()."""

    def __init__(self, want_colors: bool) -> None:
        # Python's own signal handler writes the number of each signal to the pipe, and does nothing
        # else; wait_key() reads it. The pipe stays open: threads may still call wake().
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._keys = sys.stdin.fileno()
        for number in _SIGNALS:
            signal.signal(number, _ignored)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        # curses installs no handler of its own for a signal that has one already.
        self._window = curses.initscr()
        self._set_modes()
        self._attributes = _attributes(want_colors)

    def _set_modes(self) -> None:
        curses.noecho()
        curses.cbreak()
        self._window.keypad(True)
        self._window.nodelay(True)
        curses.set_escdelay(25)
        with suppress(curses.error):  # a terminal that cannot hide its cursor
            curses.curs_set(0)

    def size(self) -> tuple[int, int]:
        """Columns and rows of the terminal; 80 and 24 if it does not know."""
        # Not $COLUMNS and $LINES, which stay as they are when the terminal is resized.
        known = os.get_terminal_size(sys.stdout.fileno())
        columns, rows = known.columns or 80, known.lines or 24
        if curses.is_term_resized(rows, columns):
            curses.resize_term(rows, columns)
        return columns, rows

    def show(self, lines: Sequence[Line]) -> None:
        """Draw these lines and nothing else. The lines must fit into size()."""
        self._window.erase()
        for row, line in enumerate(lines):
            attributes = sum(self._attributes[word] for word in line.style.split())
            with suppress(curses.error):  # the terminal has become smaller
                # Not addstr(), which would continue in the next row.
                self._window.insstr(row, 0, one_line(line.text), attributes)
        self._window.refresh()

    def wait_key(self, seconds: float) -> str:
        """The key pressed within `seconds`, with its name as in curses(3), "a" or "KEY_UP".

        "" without a key, after a signal and after wake().
        """
        if key := self._read_key():
            return key
        ready, _, _ = select.select([self._keys, self._woken], [], [], max(seconds, 0.0))
        if self._woken in ready:
            self._take_signals(os.read(self._woken, 512))
        # No data means that the terminal is gone.
        return self._read_key() or "q" if self._keys in ready else ""

    def wake(self) -> None:
        """Let wait_key() return; from any thread."""
        with suppress(BlockingIOError):  # it is about to return
            os.write(self._wake, b"\0")

    def _read_key(self) -> str:
        try:
            return self._window.getkey()
        except curses.error:
            return ""

    def _take_signals(self, numbers: bytes) -> None:
        for number in numbers:
            if number in _ENDINGS:
                raise _Ended(number)
        if signal.SIGTSTP in numbers:
            curses.endwin()
            # Not SIGSTOP: the kernel ignores this one if no shell can continue us, as over ssh.
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTSTP)
            signal.signal(signal.SIGTSTP, _ignored)
        # After SIGWINCH and SIGCONT, the terminal may show anything.
        self._window.clearok(any(numbers))


@contextmanager
def open_screen(want_colors: bool) -> Iterator[Screen]:
    """The whole terminal, until the end of the block, also by an exception or a signal.

    Raises DoraSystemdError for a terminal without an entry in terminfo.
    """
    try:
        curses.setupterm()
    except curses.error as error:
        name = os.environ.get("TERM", "")
        hint = "run TERM=xterm doractl top, or doractl top --once"
        raise DoraSystemdError(f"cannot use the terminal {name}: {error}", hint) from error
    try:
        yield Screen(want_colors)
    except _Ended as ended:
        _give_back()
        os.kill(os.getpid(), ended.args[0])
    finally:
        _give_back()


def _give_back() -> None:
    with suppress(curses.error):  # it has not been taken
        curses.endwin()
    signal.set_wakeup_fd(-1)
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def _ignored(_number: int, _frame: object) -> None:
    """Without a handler, Python would not write to the pipe."""


def _attributes(want_colors: bool) -> dict[str, int]:
    """Return the attribute for each word of a style."""
    attributes = {"bold": curses.A_BOLD, "reverse": curses.A_REVERSE, **dict.fromkeys(_COLORS, 0)}
    with suppress(curses.error):  # a terminal without colours
        if want_colors:
            curses.start_color()
            curses.use_default_colors()
            for pair, (word, color) in enumerate(_COLORS.items(), 1):
                curses.init_pair(pair, color, -1)
                attributes[word] = curses.color_pair(pair)
    return attributes


FIRST_SECONDS = 0.5
"""Time between the two samples of one reading."""


class Work(Thread):
    """A change that is being made in a thread; a stop can take the whole grace duration.

    A daemon thread, so that Ctrl+C ends doractl; systemd continues the change, as after Ctrl+C in
    `doractl stop`.
    """

    def __init__(self, scope: Scope, change: Change, view: TopScreen, screen: Screen) -> None:
        super().__init__(daemon=True)
        self._scope, self.change = scope, change
        self._view, self._screen = view, screen
        self.result = ""

    def run(self) -> None:
        action, row = self.change
        try:
            self._say(f"{self.change} ...")
            by = "doractl top"
            bus = Bus(self._scope)
            cell = Selector(row.uuid).find_present(bus, self._scope)
            self.result = act_on(
                bus, self._scope, cell, row.node, action, by=by, on_stage=self._say_stage
            )
        except Exception as error:  # whatever it is, it must not be printed over the screen
            is_ours = isinstance(error, DoraSystemdError)
            self.result = f"doractl: {error if is_ours else repr(error)}"
        self._say(self.result)

    def _say_stage(self, stage: str) -> None:
        self._say(f"{self.change}: {stage}")

    def _say(self, text: str) -> None:
        self._view.said = text
        self._screen.wake()


def show_live(scope: Scope, top: Top, interval: float, sort: str) -> None:
    """Show one reading after the other, until the person quits.

    interval: seconds between two. Changes that are not finished then are waited for. Raises
    DoraSystemdError.
    """
    view, works = TopScreen(sort), list[Work]()
    with open_screen(wants_colors(sys.stdout)) as screen:
        view.see(top.look())
        due = time.monotonic() + FIRST_SECONDS
        while not view.is_over:
            screen.show(view.lines(*screen.size()))
            if change := view.press(screen.wait_key(due - time.monotonic())):
                works.append(Work(scope, change, view, screen))
                works[-1].start()
            if time.monotonic() >= due:
                view.see(top.look())
                due = time.monotonic() + interval
        works = [work for work in works if work.is_alive()]
    for work in works:
        click.echo(f"{work.change} ...", err=True)
        work.join()
        click.echo(work.result)
