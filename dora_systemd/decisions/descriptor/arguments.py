"""Splits `args:` of a node into words as dora's daemon does, by the rules of Rust's crate shlex.

Python's shlex differs: there "#" begins no comment, a carriage return separates words, a backslash
before a newline keeps the newline, and in double quotes it also escapes nothing but '"' and itself.
"""

import re

_BLANKS = " \t\n"
_GAP = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
"""Between words. A "#" that begins a word begins a comment."""
_PIECE = re.compile(
    r"""'(?P<literal>[^']*)'|"(?P<quoted>(?:[^"\\]|\\.)*)"|\\(?P<one>.)|(?P<plain>[^ \t\n'"\\]+)""",
    re.DOTALL,
)
_ESCAPE = re.compile(r'\\(?:\n|([$`"\\]))')
"""In double quotes; before any other character a backslash is itself."""


def split_arguments(text: str) -> list[str]:
    """The words of `text`. Raises ValueError for an open quote and for a backslash at the end."""
    words = []
    place = _end_of_gap(text, 0)
    while place < len(text):
        word, place = _next_word(text, place)
        words.append(word)
        place = _end_of_gap(text, place)
    return words


def _end_of_gap(text: str, place: int) -> int:
    match = _GAP.match(text, place)
    return match.end() if match else place


def _next_word(text: str, place: int) -> tuple[str, int]:
    """The word that begins at `place`, and where it ends."""
    word = ""
    while place < len(text) and text[place] not in _BLANKS:
        piece = _PIECE.match(text, place)
        if piece is None:
            raise ValueError("a backslash ends it" if text[place] == "\\" else "a quote is open")
        word += _value(piece)
        place = piece.end()
    return word, place


def _value(piece: re.Match[str]) -> str:
    text = piece[0] if piece.lastgroup is None else piece[piece.lastgroup]
    if piece.lastgroup == "quoted":
        return _ESCAPE.sub(lambda match: match[1] or "", text)
    return "" if piece.lastgroup == "one" and text == "\n" else text
