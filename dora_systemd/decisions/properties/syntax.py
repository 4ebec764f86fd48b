"""The syntax of unit files: words, quotes, escapes and specifiers, as in systemd.syntax(7)."""

import re

SPACE = " \t\n\r"

_ESCAPES = {
    **{"a": "\a", "b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t", "v": "\v", "s": " "},
    **{"\\": "\\", '"': '"', "'": "'"},
}
_NUMERIC = re.compile(r"x([0-9a-fA-F]{2})|u([0-9a-fA-F]{4})|U([0-9a-fA-F]{8})|([0-7]{3})")
# The first branch skips pairs of backslashes, after which there is no escape.
_BYTES = re.compile(r"\\\\|(?:\\[23][0-7]{2}|\\x[89a-fA-F][0-9a-fA-F])+")
_BYTE = re.compile(r"\\x(..)|\\(...)")
_PLAIN_WORD = re.compile(r"[A-Za-z0-9_@%=:,./+~^!?*\[\]-]+")
_NEEDS_ESCAPE = re.compile(r'[\\"\x00-\x1f\x7f]')


def split_words(text: str, separators: str = SPACE) -> list[str]:
    """The words of `text`, split at any of `separators`, with quotes and C escapes resolved.

    Raises ValueError for an unfinished quote or escape. Adjacent blanks are one separator; between
    any other separators there are empty words.
    """
    words: list[str] = []
    word: str | None = None
    text = _BYTES.sub(_characters, text)
    quote, place = "", 0
    while place < len(text):
        char, length = text[place], 1
        if char == "\\":
            char, length = _unescaped(text, place)
            word = (word or "") + char
        elif quote:
            word = (word or "") + (char if char != quote else "")
            quote = "" if char == quote else quote
        elif char in "\"'":
            word, quote = word or "", char
        elif char in separators:
            words += [] if word is None and char in SPACE else [word or ""]
            # "a:" ends with an empty word, "a " does not.
            word = None if char in SPACE else ""
        else:
            word = (word or "") + char
        place += length
    if quote:
        raise ValueError("a quote is not closed")
    return words + ([] if word is None else [word])


def escape_specifiers(text: str) -> str:
    """`text` with % doubled, because systemd.unit(5) expands specifiers."""
    return text.replace("%", "%%")


def quote_word(text: str) -> str:
    """`text` as one word of a list in a unit file, quoted and escaped if necessary."""
    escaped = escape_specifiers(text)
    if _PLAIN_WORD.fullmatch(escaped):
        return escaped
    return '"' + _NEEDS_ESCAPE.sub(_escaped, escaped) + '"'


def _characters(match: re.Match[str]) -> str:
    """Decodes escaped bytes as UTF-8: systemd writes all non-ASCII characters like this."""
    pairs = _BYTE.findall(match[0])
    data = bytes(
        int(hexadecimal, 16) if hexadecimal else int(octal, 8) for hexadecimal, octal in pairs
    )
    try:
        return data.decode() or match[0]
    except UnicodeDecodeError:
        return match[0]


def _unescaped(text: str, place: int) -> tuple[str, int]:
    """The character of the escape at `place`, and the length of the escape."""
    letter = text[place + 1 : place + 2]
    if not letter:
        raise ValueError("a backslash ends it")
    match = _NUMERIC.match(text, place + 1)
    if match:
        digits = match[1] or match[2] or match[3]
        code = int(digits, 16) if digits else int(match[4], 8)
        if not 0 < code < 0x110000 or 0xD800 <= code < 0xE000:
            raise ValueError("an escape stands for no character")
        return chr(code), 1 + len(match[0])
    # Any other escaped character means itself, as in paths.
    return _ESCAPES.get(letter, letter), 2


def _escaped(match: re.Match[str]) -> str:
    char = match[0]
    return {"\n": "\\n", "\t": "\\t", "\\": "\\\\", '"': '\\"'}.get(char, f"\\x{ord(char):02x}")
