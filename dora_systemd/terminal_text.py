"""What somebody else wrote must not command the terminal: one rule for every place. Pure.

A terminal obeys the control characters of ECMA-48 in their 7-bit and in their 8-bit form, see
console_codes(4): OSC 52 writes the clipboard, others change its title or what was printed above.
Bidirectional controls show a line in another order than it has. All of them are shown escaped.
"""

import re

# C0 but tab and newline, DEL, C1; bidirectional controls; separators that some take for line ends;
# halves of surrogate pairs, which are bytes of file names that are no UTF-8; language tags, which
# nobody sees.
_COMMANDS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
    "\ud800-\udfff\ufeff\U000e0000-\U000e007f]"
)
_SEQUENCES = re.compile(
    r"(?:\x1b\[|\x9b)[0-?]*[ -/]*[@-~]"  # CSI
    r"|(?:\x1b[PX\]^_]|[\x90\x98\x9d-\x9f])[^\x07\x1b\x9c]*(?:\x07|\x1b\\|\x9c)?"  # OSC, DCS ...
    r"|\x1b[@-Z\\-_]"
)
_COLORS = re.compile(r"\x1b\[[0-9;:]*m")
_RESET = "\x1b[0m"


def escaped(text: str) -> str:
    r"""`text` as a terminal may be given it: what would command it is shown, as in \x1b."""
    return _COMMANDS.sub(_escape, text)


def one_line(text: str) -> str:
    """The same in one line: tabs and newlines are blanks."""
    return escaped(text.replace("\n", " ").replace("\t", " "))


def short_line(text: str, most: int) -> str:
    """Words of somebody else within a message: one line without needless blanks, `most` bytes."""
    line = " ".join(one_line(text).split())
    if len(line.encode()) <= most:
        return line
    return f"{line.encode()[: most - 3].decode(errors='ignore')}..."


def without_sequences(text: str) -> str:
    """`text` without colours and other whole sequences: for who shows none."""
    return _SEQUENCES.sub("", text)


def shown_log(data: bytes) -> bytes:
    """Lines of a log, as a terminal may be given them: their colours pass, up to the end of each.

    Bytes that are no UTF-8 are shown escaped; so is all else that would command the terminal.
    """
    text = data.decode("utf-8", "backslashreplace")
    if not _COMMANDS.search(text):
        return text.encode()
    return "\n".join(_shown_line(line.rstrip("\r")) for line in text.split("\n")).encode()


def _shown_line(line: str) -> str:
    pieces = _COLORS.split(line)
    if len(pieces) == 1:
        return escaped(line)
    colors = [*_COLORS.findall(line), ""]
    shown = "".join(escaped(text) + color for text, color in zip(pieces, colors, strict=True))
    return shown if shown.endswith(_RESET) else f"{shown}{_RESET}"


def _escape(match: re.Match[str]) -> str:
    code = ord(match[0])
    if code < 0x7F:
        return f"\\x{code:02x}"
    # JSON may have these as they are, and reads them like this, too.
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
