"""Formats lines of the journal for a terminal: aligned, with a colour for each node, without noise.

It rewrites journalctl's `short` output in chunks, because there can be hundreds of thousands of
lines.
"""

import re
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.logs.noise import is_same, is_told_by_event, repeated
from dora_systemd.names import MAX_NAME, MAX_NODE_ID
from dora_systemd.terminal_text import COLOR_BYTES, one_line, shown_log

# The beginning of a line of `journalctl -o short`, with or without journalctl's own colours, or
# what it prints before the second and later lines of a message.
_PREFIX = re.compile(
    rb"^(?:(?P<time>[A-Z][a-z]{2} [ \d]\d \d\d:\d\d:\d\d(?:\.\d+)?) \S+ (?:\x1b\[[0-9;:]*m)*"
    rb"(?P<dataflow>[A-Za-z0-9][A-Za-z0-9._-]*)(?:/(?P<node>[^\s\[]+))?(?:\[\d+\])?"
    rb"(?:\x1b\[[0-9;:]*m)*: |(?P<indent> {20,}))",
    re.M,
)
# Readable on dark and light backgrounds, without journalctl's own red and yellow.
_COLORS = (32, 34, 35, 36, 92, 94, 95, 96)
# Colours of messages by PRIORITY, as in journalctl.
_MESSAGE_COLORS = {b"3": b"\x1b[0;1;31m", b"4": b"\x1b[0;1;38:5:185m", b"7": b"\x1b[0;38:5:245m"}
MAX_WIDTH = 24
# Names whose last line is kept: a node can write to the journal under any number of names.
MOST_NAMES = 2000
_LONGEST_NAME = MAX_NAME + 1 + MAX_NODE_ID
_LONGEST_TEXT = 16 * 1024
_MARK = b"\0"
"""Before each record while it is rewritten: ShownLines leaves none in a text."""


@dataclass
class _Said:
    """The last line of a node: its beginning, its rest, and how often the line was repeated."""

    start: bytes = b""
    text: bytes = b""
    times: int = 1

    def ending(self) -> bytes:
        """Format the line that counts the repetitions; b"" without any."""
        again = repeated(self.text.decode("utf-8", "replace").rstrip("\n"), self.times)
        return self.start + again.encode() + b"\n" if again else b""


def color_of(node: str) -> int:
    """The ANSI colour of a node: always the same, on every machine."""
    return _COLORS[zlib.crc32(node.encode("utf-8", "replace")) % len(_COLORS)]


class TerminalLines:
    """Rewrites journalctl's short lines; formats records as such lines.

    nodes: known names, for the width of their column. want_dataflow: show the name of the dataflow.
    want_colors: for nodes and priorities. is_terminal: escape control characters. has_events: the
    life events are among the lines, so lines of dora's daemon about the same ends are left out.
    """

    def __init__(
        self,
        nodes: Iterable[str] = (),
        want_dataflow: bool = False,
        want_colors: bool = True,
        is_terminal: bool = True,
        has_events: bool = False,
    ) -> None:
        self._width = min(max(map(len, nodes), default=0), MAX_WIDTH)
        self._want_dataflow = want_dataflow
        self._want_colors = want_colors
        self._is_terminal = is_terminal
        self._has_events = has_events
        self._labels: dict[bytes, bytes] = {}
        self._said: dict[bytes, _Said] = {}
        self._last: list[bytes] = []
        self._whole = ShownLines()
        self._old_indent = self._new_indent = 0

    def feed(self, data: bytes) -> bytes:
        """Rewrite the lines that `data` completes, except the last record, which may be partial."""
        shown = self._whole.feed(data)
        if not self._want_colors:
            shown = re.sub(COLOR_BYTES, b"", shown)
        before, *parts = _PREFIX.sub(self._rewrite, shown).split(_MARK)
        if self._last:
            self._last[-1] += before
            before = b""
        parts = [*self._last, *parts]
        self._last = parts[-3:]
        return before + self._without_repeats(parts[:-3])

    def flush(self) -> bytes:
        """Return the rest: the last record, and how often the last line of each node came."""
        last, self._last = self._without_repeats(self._last), []
        return last + self._endings()

    def _endings(self) -> bytes:
        """Discard the last lines of all nodes; return the lines that count their repetitions."""
        said, self._said = self._said, {}
        return b"".join(one.ending() for one in said.values())

    def _without_repeats(self, parts: Sequence[bytes]) -> bytes:
        """The lines of records, of which each has three parts: origin, begin of the line, rest."""
        shown: list[bytes] = []
        for name, start, text in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
            if self._has_events and is_told_by_event(name, text):
                continue
            said = self._said.get(name)
            if said is None:
                if len(self._said) >= MOST_NAMES:
                    shown.append(self._endings())
                said = _Said()
                if len(name) <= _LONGEST_NAME:
                    self._said[name] = said
            elif is_same(said.text, text):
                said.start, said.text, said.times = start, text, said.times + 1
                continue
            elif said.times > 1:
                shown.append(said.ending())
            said.text, said.times = text if len(text) <= _LONGEST_TEXT else b"", 1
            shown += (start, text)
        return b"".join(shown)

    def record(self, record: Mapping[str, bytes]) -> bytes:
        """The lines of one record of the Journal Export Format."""
        seconds = int(record.get("__REALTIME_TIMESTAMP", b"0")) // 1_000_000
        when = time.strftime("%b %d %H:%M:%S", time.localtime(seconds)).encode()
        start = self._start(when, *record.get("SYSLOG_IDENTIFIER", b"").partition(b"/")[::2])
        text = record.get("MESSAGE", b"")
        text = shown_log(text) if self._is_terminal else text
        text = text.replace(b"\n", b"\n" + b" " * self._new_indent)
        color = _MESSAGE_COLORS.get(record.get("PRIORITY", b""))
        if color and self._want_colors:
            text = color + text + b"\x1b[0m"
        return start + text + b"\n"

    def _rewrite(self, match: re.Match[bytes]) -> bytes:
        if (indent := match["indent"]) is not None:
            if len(indent) < self._old_indent:
                return indent
            return b" " * (len(indent) - self._old_indent + self._new_indent)
        self._old_indent = len(match[0]) - _escapes(match[0])
        dataflow, node = match["dataflow"], match["node"] or b""
        start = self._start(match["time"], dataflow, node)
        return _MARK.join((b"", dataflow + b"/" + node, start, b""))

    def _start(self, when: bytes, dataflow: bytes, node: bytes) -> bytes:
        name = node
        if self._want_dataflow or not node:
            name = dataflow + (b"/" + node if node else b"")
        label = self._labels.get(name) or self._label(name)
        self._new_indent = len(when) + self._width + 2
        return b"%s %s " % (when, label)

    def _label(self, name: bytes) -> bytes:
        text = one_line(name[:_LONGEST_NAME].decode("utf-8", "replace"))
        if len(self._labels) >= MOST_NAMES:
            self._labels.clear()
        if (width := min(len(text), MAX_WIDTH)) > self._width:
            self._width = width
            self._labels.clear()
        padded = f"{text:<{self._width}}"
        if self._want_colors:
            padded = f"\x1b[{color_of(text)}m{padded}\x1b[0m"
        label = padded.encode("utf-8", "replace")
        if len(name) <= _LONGEST_NAME:
            self._labels[name] = label
        return label


class ShownLines:
    """Passes lines of journalctl's other formats to a terminal, with control characters escaped."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> bytes:
        """The lines that `data` completes."""
        whole, end, rest = data.rpartition(b"\n")
        if not end:
            self._rest += data
            return b""
        done, self._rest = self._rest + whole + end, rest
        return shown_log(done)

    def flush(self) -> bytes:
        """Return b"", because no line is held back."""
        return b""


def _escapes(text: bytes) -> int:
    return sum(map(len, re.findall(rb"\x1b\[[0-9;:]*m", text))) if b"\x1b" in text else 0
