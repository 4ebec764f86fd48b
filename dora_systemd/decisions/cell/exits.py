"""How a process ended: one value, and the one text for it.

The text is in the journal (DORA_EXIT=) and in status.json.
"""

import re
import signal
from enum import Enum
from typing import NamedTuple


class ExitKind(Enum):
    """The kind of end of a process. The value is the beginning of the text."""

    OTHER = ""
    CODE = "exit code "
    SIGNAL = "signal "
    HUNG = "hung, "
    SILENT = "silent, "


class Exit(NamedTuple):
    """How a process ended; Exit() is success, or no end yet."""

    kind: ExitKind = ExitKind.OTHER
    number: int = 0  # the exit status or the signal
    words: str = ""  # the rest of the text
    by: str = ""  # the node whose failure was the cause, or ""

    @property
    def is_failure(self) -> bool:
        """Whether the process ended, and not with success."""
        return self != Exit()

    @property
    def is_terminated(self) -> bool:
        """Whether SIGTERM ended the process, or it exited as a shell does then."""
        return self in (exit_of(-signal.SIGTERM), exit_of(128 + signal.SIGTERM))

    def details(self) -> dict[str, str]:
        """The detail `exit` of a life event; success has none."""
        return {"exit": str(self)} if self.is_failure else {}

    def __str__(self) -> str:
        """The text, "" for success. Inverse of parse_exit."""
        numbers = {ExitKind.CODE: str(self.number), ExitKind.SIGNAL: _signal_name(self.number)}
        how = f"{self.kind.value}{numbers.get(self.kind, '')}{self.words}"
        if not self.by:
            return how
        return f"{how}{_BECAUSE}{self.by}{_FAILED}" if how else f"{_NODE}{self.by}{_EARLY}"


_BECAUSE, _FAILED = " because node ", " failed"
_NODE, _EARLY = "node ", " failed before the start"
_NUMBERED = r"(exit code |signal )(-?(?:0|[1-9][0-9]{0,9})|SIG[A-Z0-9]+)"


def _signal_name(number: int) -> str:
    """SIGKILL for 9; the number as text where it has no name."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)


_SIGNALS = {_signal_name(number): number for number in range(1, signal.NSIG)}


def exit_of(status: int) -> Exit:
    """The end of a child: its exit status, or minus the signal that killed it, as in subprocess."""
    return Exit(ExitKind.CODE, status) if status >= 0 else Exit(ExitKind.SIGNAL, -status)


KILLED = exit_of(-signal.SIGKILL)
EARLY = Exit(ExitKind.CODE, 0, " before it called dora")
"""A node that never called Node(): dora then fails the nodes that wait for it at the start."""


def parse_exit(text: str) -> Exit:
    """Parse the end that `text` describes. A text of another version becomes the `words`."""
    # The owner of a dataflow can write the text: no recursion, no pattern that backtracks.
    how, _, node = text.rpartition(_BECAUSE)
    if how and (by := node.removesuffix(_FAILED)) not in ("", node):
        return _parse_own(how)._replace(by=by)
    by = text[len(_NODE) : -len(_EARLY)]
    if by and text == f"{_NODE}{by}{_EARLY}":
        return Exit(by=by)
    return _parse_own(text)


def _parse_own(text: str) -> Exit:
    """Parse a text that names no other node."""
    for kind in (ExitKind.HUNG, ExitKind.SILENT):
        if text.startswith(kind.value):
            return Exit(kind, words=text.removeprefix(kind.value))
    if numbered := re.match(_NUMBERED, text):
        kind, words = ExitKind(numbered[1]), text[numbered.end() :]
        if kind is ExitKind.CODE and not numbered[2].startswith("SIG"):
            return Exit(kind, int(numbered[2]), words)
        if kind is ExitKind.SIGNAL and numbered[2] in _SIGNALS:
            return Exit(kind, _SIGNALS[numbered[2]], words)
    return Exit(words=text)


def find_exit(text: str) -> Exit:
    """Find the first exit status or signal in a text; Exit() for none."""
    numbered = re.search(_NUMBERED, text)
    return parse_exit(text[numbered.start() :]) if numbered else Exit()
