"""Parses the files of --env-file, in the syntax of EnvironmentFile= in systemd.exec(5).

A value may begin with quoted parts, and continue without quotes up to the end of its line. A quote
in that rest is an ordinary character, so JSON needs no other quotes around it.
"""

import re

from dora_systemd.decisions.cell.environment import parse_assignment
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.values import shown

_ENTRY = r"(?:\s|[#;].*)*(?P<key>[^=\n]*)(?P<equals>=?)"
"""A name, and the blank lines and comments before it."""
_PART = (
    r"""(?s)[ \t\r]*(?:'(?P<single>[^']*)(?P<end>')?|"(?P<double>(?:[^"\\]|\\.)*)(?P<ends>")?)"""
)
_REST = r"(?s)(?:[^\n\\]|\\.)*\\?"
_WORD = r"(?s)[^\\]+|\\.?"
_ESCAPED = r"""\\(["\\$`])|\\\n"""
_BLANK = " \t\r"


def parse_environment_file(text: str, source: str) -> dict[str, str]:
    """Return the variables of an environment file.

    source: the file's name, for errors. Raises DoraSystemdError (BAD_INPUT).
    """
    variables: dict[str, str] = {}
    place = 0
    while (match := re.compile(_ENTRY).match(text, place)) and match[0]:
        place = match.end()
        try:
            if match["equals"]:
                value, place = _value(text, place)
                key, value = parse_assignment(f"{match['key'].strip()}={value}")
                variables[key] = value
            elif match["key"].strip():
                parse_assignment(match["key"])
        except DoraSystemdError as error:
            # The line may contain a secret.
            number = text.count("\n", 0, match.start("key")) + 1
            message = f"cannot read line {number} of {shown(source)} as KEY=VALUE"
            raise bad_input(message, error.hint) from error
    return variables


def _value(text: str, place: int) -> tuple[str, int]:
    """Read the value that begins at `place`; return the value and where it ends."""
    parts = []
    while match := re.compile(_PART).match(text, place):
        if not (match["end"] or match["ends"]):
            hint = "a quote is not closed: a value is one line of text"
            raise usage_error("cannot read a value", hint)
        place = match.end()
        in_double = match["double"]
        parts.append(match["single"] if in_double is None else re.sub(_ESCAPED, r"\1", in_double))
    rest = re.compile(_REST).match(text, place)
    assert rest is not None
    return "".join([*parts, _without_quotes(rest[0])]), rest.end()


def _without_quotes(text: str) -> str:
    """Return text in which a backslash makes the next character literal, also a last blank."""
    words = re.findall(_WORD, text.lstrip(_BLANK))
    if words and not words[-1].startswith("\\"):
        words[-1] = words[-1].rstrip(_BLANK)
    return "".join(word[1:].strip("\n") if word.startswith("\\") else word for word in words)
