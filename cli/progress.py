"""How far a deploy or a rollback is, on standard error.

On a terminal it is one line that is rewritten; in a pipe a line, or a JSON object, whenever there
is something new.
"""

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from math import inf
from typing import TextIO

import click

from dora_systemd.cli.edge import print_object
from dora_systemd.cli.parameters import print_warnings, wants_json
from dora_systemd.cli.terminal import StageLine, is_dumb
from dora_systemd.decisions.releases.progress import Pace, Step
from dora_systemd.decisions.views.releases import step_object
from dora_systemd.terminal_text import one_line

_TERMINAL_SECONDS = 0.1
_JSON_SECONDS = 1.0
_PIPE_SECONDS = 10.0
SIGN_SECONDS = 30.0
"""A program gets a sign of life at least so often; deploy -H gives up a host that sends none."""

quiet_option = click.option(
    "-q", "--quiet", "is_quiet", is_flag=True, help="Print nothing but errors."
)
"""Option for verbs that show progress."""


class Progress(AbstractContextManager["Progress"]):
    """Shows the steps that it is called with, until the `with` block ends."""

    def __init__(
        self,
        stream: TextIO,
        is_json: bool = False,
        is_quiet: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        is_terminal = stream.isatty() and not is_json and not is_dumb()
        self._stream = stream
        self._is_json = is_json
        self._is_off = is_quiet
        self._clock = clock
        self._line = StageLine(stream) if is_terminal else None
        seconds = _JSON_SECONDS if is_json else _PIPE_SECONDS
        silence = SIGN_SECONDS if is_json else inf
        self._pace = Pace(_TERMINAL_SECONDS if is_terminal else seconds, silence)

    def __call__(self, step: Step) -> None:
        if not self._is_off and self._pace.takes(step, self._clock()):
            self._show(step)

    def warn(self, text: str) -> None:
        if not self._is_off:
            self._wipe()
            print_warnings([text])

    def __exit__(self, *_exception: object) -> None:
        self._wipe()

    def _show(self, step: Step) -> None:
        if self._line:
            self._line(step.text)
        elif self._is_json:
            print_object("progress", step_object(step))
        else:
            print(one_line(step.text), file=self._stream, flush=True)

    def _wipe(self) -> None:
        if self._line:
            self._line.wipe()


def open_progress(is_quiet: bool) -> Progress:
    """Return the Progress of this command line."""
    return Progress(sys.stderr, wants_json(), is_quiet)
