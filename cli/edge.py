"""The edge: all that doractl writes goes through it, so that no text of others reaches a terminal.

Names of files, what nodes wrote and what systemd says about them get into tables and messages in
many places. One stream that shows control characters escaped cannot be forgotten in any of them.
"""

import io
import sys
from typing import TextIO

from dora_systemd.terminal_text import escaped


class Edge(io.TextIOWrapper):
    """A stream that writes text as terminal_text.escaped() shows it."""

    def write(self, text: str) -> int:
        """Write `text`, with what would command a terminal escaped."""
        return super().write(escaped(text))

    def write_own(self, text: str) -> None:
        """Write `text` as it is."""
        super().write(text)


def put_in_place() -> None:
    """Have standard output and error go through the edge from now on."""
    sys.stdout, sys.stderr = (_edge(one) for one in (sys.stdout, sys.stderr))


def _edge(stream: TextIO) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):  # none at all, or a test's
        return stream
    # Names of files need not be in the terminal's encoding.
    return Edge(
        stream.buffer,
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
    )


def write_own(stream: TextIO, text: str) -> None:
    """Write a text of ours, with control sequences of ours in it."""
    if isinstance(stream, Edge):
        stream.write_own(text)
    else:
        stream.write(text)


def write_exactly(text: str) -> None:
    """Print what a program is to read: as it is in a pipe or a file, for a terminal as all else."""
    if sys.stdout.isatty():
        sys.stdout.write(text)
    else:
        write_own(sys.stdout, text)
