"""The syntax of unit files: words, quotes, escapes and specifiers, as in systemd.syntax(7)."""

import re

_PART = re.compile(
    r"""
    (?P<blank> [ \t\n\r]+ )
    | " (?P<double> (?: [^"\\] | \\. )* ) "
    | ' (?P<single> (?: [^'\\] | \\. )* ) '
    | (?P<plain> (?: [^"'\\ \t\n\r] | \\. )+ )
    | (?P<unfinished> . )
    """,
    re.DOTALL | re.VERBOSE,
)
_ESCAPE = re.compile(
    r"""
    (?P<bytes> (?: \\[23][0-7]{2} | \\x[89a-fA-F][0-9a-fA-F] )+ )
    | \\ (?P<octal> [0-7]{3} )
    | \\ (?: x([0-9a-fA-F]{2}) | u([0-9a-fA-F]{4}) | U([0-9a-fA-F]{8}) )
    | \\ (?P<letter> . )
    """,
    re.DOTALL | re.VERBOSE,
)
_LETTERS = {"a": "\a", "b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t", "v": "\v", "s": " "}
_PLAIN_WORD = re.compile(r"[A-Za-z0-9_@%=:,./+~^!?*\[\]-]+")
_NEEDS_ESCAPE = re.compile(r'[\\"\x00-\x1f\x7f]')


def split_words(text: str) -> list[str]:
    """The words of `text`, split at blanks, with quotes and C escapes resolved.

    Raises ValueError for an unfinished quote or escape.
    """
    words: list[str] = []
    is_inside = False
    for part in _PART.finditer(text):
        name = part.lastgroup or ""
        if name == "unfinished":
            raise ValueError("a quote is not closed, or a backslash ends it")
        if name == "blank":
            is_inside = False
            continue
        words += [] if is_inside else [""]
        words[-1] += _ESCAPE.sub(_unescaped, part[name])
        is_inside = True
    return words


def escape_specifiers(text: str) -> str:
    """`text` with % doubled, because systemd.unit(5) expands specifiers."""
    return text.replace("%", "%%")


def quote_word(text: str) -> str:
    """`text` as one word of a list in a unit file, quoted and escaped if necessary."""
    escaped = escape_specifiers(text)
    if _PLAIN_WORD.fullmatch(escaped):
        return escaped
    return '"' + _NEEDS_ESCAPE.sub(_escaped, escaped) + '"'


def _unescaped(match: re.Match[str]) -> str:
    """Replace an escape; any other escaped character is literal, as in paths."""
    letter, octal = match["letter"], match["octal"]
    if letter:
        return _LETTERS.get(letter, letter)
    if match["bytes"]:
        return _characters(match["bytes"])
    code = int(octal, 8) if octal else int(match[match.lastindex or 0], 16)
    if not 0 < code < 0x110000 or 0xD800 <= code < 0xE000:
        raise ValueError("an escape stands for no character")
    return chr(code)


def _characters(escapes: str) -> str:
    """Decodes escaped bytes as UTF-8: systemd writes all non-ASCII characters like this."""
    codes = escapes.split("\\")[1:]
    data = bytes(int(one[1:], 16) if one.startswith("x") else int(one, 8) for one in codes)
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _escaped(match: re.Match[str]) -> str:
    char = match[0]
    return {"\n": "\\n", "\t": "\\t", "\\": "\\\\", '"': '\\"'}.get(char, f"\\x{ord(char):02x}")
