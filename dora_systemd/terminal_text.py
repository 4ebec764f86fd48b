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
