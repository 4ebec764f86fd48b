"""The terminal of doractl: whether to write colours, and one status line during a wait."""

import os
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import TextIO

from dora_systemd.cli.edge import write_own
from dora_systemd.errors import DoraSystemdError
from dora_systemd.terminal_text import one_line
from dora_systemd.values import parse_bool


def is_dumb(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether the terminal cannot move its cursor or show colours."""
    return environ.get("TERM", "dumb") in ("", "dumb")


def wants_colors(stream: TextIO, environ: Mapping[str, str] = os.environ) -> bool:
    """Whether output to `stream` is coloured.

    $SYSTEMD_COLORS decides: a boolean, or a number of colours. Else there are colours on a terminal
    that has them, unless $NO_COLOR is set.
    """
    given = environ.get("SYSTEMD_COLORS", "")
    if given and not given.startswith("auto"):
        try:
            return (given.isdecimal() and int(given) > 1) or parse_bool(given)
        except (DoraSystemdError, ValueError):
            pass  # systemd ignores a word that it does not know
    return stream.isatty() and not is_dumb(environ) and not environ.get("NO_COLOR")


_BACK_AND_CLEAR = "\r\x1b[K"


class StageLine(AbstractContextManager["StageLine"]):
    """Shows the text of the last call, until the `with` block ends and erases it.

    is_stop: what is waited for is an end, so that no machine is awaited.
    """

    def __init__(self, stream: TextIO, is_stop: bool = False) -> None:
        self._stream = stream
        self._is_stop = is_stop
        self._is_terminal = stream.isatty()
        self._shown = ""

    def __call__(self, text: str) -> None:
        if not self._is_terminal:
            self._tell_machine(text)
            return
        from shutil import get_terminal_size

        shown = one_line(text)[: get_terminal_size().columns - 1]
        if shown != self._shown:
            self._write(f"{_BACK_AND_CLEAR}{shown}")
            self._shown = shown

    def _tell_machine(self, text: str) -> None:
        """Print which machine a start waits for, because the wait may be long."""
        if self._is_stop or not text.startswith("waiting for machine") or text == self._shown:
            return
        # Imported late: most dataflows run on one machine.
        from dora_systemd.decisions.cell.machines import is_news

        if is_news(text):
            self._shown = text
            print(one_line(text), file=self._stream, flush=True)

    def wipe(self) -> None:
        """Make room for other output; the next stage is shown below it."""
        if self._shown and self._is_terminal:
            self._write(_BACK_AND_CLEAR)
            self._shown = ""

    def __exit__(self, *_exception: object) -> None:
        self.wipe()

    def _write(self, text: str) -> None:
        write_own(self._stream, text)
        self._stream.flush()
