"""One status line on a terminal that is rewritten during a wait; no output to a pipe."""

import shutil
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, TextIO

from dora_systemd.cli.edge import write_own
from dora_systemd.terminal_text import one_line

_BACK_AND_CLEAR = "\r\x1b[K"


class StageLine(AbstractContextManager["StageLine"]):
    """Shows the text of the last call, until the `with` block ends and erases it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._is_shown = False

    def __call__(self, text: str) -> None:
        if self._is_terminal:
            columns = shutil.get_terminal_size().columns
            shown = one_line(text)[: columns - 1]
            self._write(f"{_BACK_AND_CLEAR}{shown}")
            self._is_shown = True

    def show(self, changes: Mapping[str, Any]) -> None:
        """Show STATUS= of a unit, if it is among these changes of its properties."""
        if changes.get("StatusText"):
            self(changes["StatusText"])

    def wipe(self) -> None:
        """Make room for other output; the next stage is shown below it."""
        if self._is_shown:
            self._write(_BACK_AND_CLEAR)
            self._is_shown = False

    def __exit__(self, *_exception: object) -> None:
        self.wipe()

    def _write(self, text: str) -> None:
        write_own(self._stream, text)
        self._stream.flush()
