"""Makes foreign text safe for terminals: escapes everything that a terminal would interpret. Pure.

Terminals interpret the control characters of ECMA-48 in their 7-bit and 8-bit form, see
console_codes(4): OSC 52 writes the clipboard, others change the title or earlier output.
Bidirectional controls change the order of a line. All of them are shown escaped.
"""

import re

# C0 without tab and newline, DEL, C1; bidirectional controls; separators that some programs take
# for line ends; surrogates, which stand for bytes of file names that are not UTF-8; language tags,
# which are invisible.
_COMMANDS = (
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
    "\ud800-\udfff\ufeff\U000e0000-\U000e007f]"
)
_SEQUENCES = (
    r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]"  # CSI
    r"|(?:\x1b[PX\]^_]|[\x90\x98\x9d-\x9f])[^\x07\x1b\x9c]*(?:\x07|\x1b\\|\x9c)?"  # OSC, DCS ...
    r"|\x1b[@-Z\\-_]"
)
_COLORS = r"\x1b\[[0-9;:]*m"
COLOR_BYTES = _COLORS.encode()
"""Sequences that set colours, in bytes."""
_RESET = "\x1b[0m"

_LINE = r"\r|\x1b\[[0-2]?K"
"""What a progress bar sends: back to the begin of the line, and erase it."""
# Of a program that uses the whole screen. No mode or request makes the terminal type something, but
# for the mouse, whose modes end with the program.
_SCREEN = (
    r"[\b\x07]|\x1b[78=>M]|\x1b\([0B]|\x1b\[[0-9;]*[@A-HJ-MPSTXdfr]|\x1b\[[su]"
    r"|\x1b\[\?(?:1|7|12|25|47|100[02356]|1015|104[789]|2004|2026)[hl]"
)
_MODE = r"\x1b\[\?(\d+)([hl])"
_CURSOR = "25"
_UNFINISHED = (
    rb"(?:\x1b(?:\(|\[[0-?]{0,60}[ -/]{0,4})?"
    rb"|[\xc2-\xdf]|[\xe0-\xef][\x80-\xbf]?|[\xf0-\xf4][\x80-\xbf]{0,2})\Z"
)
"""The begin of a sequence, or of a character of several bytes, at the end of what was read."""


def escaped(text: str) -> str:
    r"""`text` as a terminal may be given it: what would command it is shown, as in \x1b."""
    return re.sub(_COMMANDS, _escape, text)


def one_line(text: str) -> str:
    """`text` escaped in one line: tabs and newlines become blanks."""
    if text.isprintable():  # as nearly all are, and tables have many cells
        return text
    return escaped(text.replace("\n", " ").replace("\t", " "))


def short_line(text: str, most: int) -> str:
    """Shorten a foreign text for a message: one line without needless blanks, `most` bytes."""
    line = " ".join(one_line(text).split())
    if len(line.encode()) <= most:
        return line
    return f"{line.encode()[: most - 3].decode(errors='ignore')}..."


def wrapped(line: str, width: int, indent: int) -> list[str]:
    """The pieces of a line that is wrapped at blanks. indent: of all but the first.

    A longer word runs over: a path in two lines cannot be copied.
    """
    # Imported late: only some verbs wrap, and only on a terminal.
    import textwrap

    return textwrap.wrap(
        line, width, subsequent_indent=" " * indent, break_on_hyphens=False, break_long_words=False
    )


def cut(text: str, width: int | None) -> str:
    """`text` with at most `width` characters, None for any number; an ellipsis is the last one."""
    return text if width is None or len(text) <= width else f"{text[: max(width - 1, 0)]}…"


def without_sequences(text: str) -> str:
    """`text` without colours and other complete sequences, for output without colours."""
    return re.sub(_SEQUENCES, "", text)


def shown_log(data: bytes) -> bytes:
    """Lines of a log for a terminal: colours pass, and end with each line.

    Escapes bytes that are not UTF-8, and everything else that a terminal would interpret.
    """
    text = data.decode("utf-8", "backslashreplace")
    if not re.search(_COMMANDS, text):
        return text.encode()
    return "\n".join(_shown_line(line.rstrip("\r")) for line in text.split("\n")).encode()


class Display:
    """What a program of another user prints, part by part, as a terminal may be given it.

    Colours and progress bars pass, and once `is_full` is set, what programs for the whole screen
    send. Everything else that a terminal would interpret is escaped.
    """

    def __init__(self) -> None:
        self.is_full = False
        self._rest = b""
        self._modes = {_CURSOR}  # those that are on
        self._color = ""  # the last sequence that has set one

    def show(self, data: bytes) -> bytes:
        """Return what to print of the next part; an unfinished end waits for the one after it."""
        data = self._rest + data
        cut = re.search(_UNFINISHED, data)
        end = cut.start() if cut else len(data)
        self._rest = data[end:]
        return self._shown(data[:end])

    def end(self) -> bytes:
        """Return what to print after the program: the rest, and the end of what it has switched."""
        rest, self._rest = self._shown(self._rest), b""
        modes = "".join(f"\x1b[?{one}l" for one in sorted(self._modes - {_CURSOR}))
        cursor = "" if _CURSOR in self._modes else f"\x1b[?{_CURSOR}h"
        color = "" if self._color in ("", "\x1b[m", _RESET) else _RESET
        return rest + f"{color}{modes}{cursor}".encode()

    def _shown(self, data: bytes) -> bytes:
        text = data.decode("utf-8", "backslashreplace")
        allowed = "|".join((_COLORS, _LINE, *([_SCREEN] if self.is_full else [])))
        passed = re.findall(allowed, text)
        for one in passed:
            if mode := re.fullmatch(_MODE, one):
                (self._modes.add if mode[2] == "h" else self._modes.discard)(mode[1])
            elif re.fullmatch(_COLORS, one):
                self._color = one
        shown = zip(re.split(allowed, text), [*passed, ""], strict=True)
        return "".join(escaped(between) + one for between, one in shown).encode()


def _shown_line(line: str) -> str:
    pieces = re.split(_COLORS, line)
    if len(pieces) == 1:
        return escaped(line)
    colors = [*re.findall(_COLORS, line), ""]
    shown = "".join(escaped(text) + color for text, color in zip(pieces, colors, strict=True))
    return shown if shown.endswith(_RESET) else f"{shown}{_RESET}"


def _escape(match: re.Match[str]) -> str:
    code = ord(match[0])
    if code < 0x7F:
        return f"\\x{code:02x}"
    # JSON allows these characters, and also this form of them.
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
