"""Kinds of unit property values: from text of `--property` to D-Bus and to unit files.

Types are those of org.freedesktop.systemd1(5), texts those of systemd-run(1). Words, quotes,
escapes and specifiers of unit files are those of systemd.syntax(7).
"""

import re
from collections.abc import Callable, Container, Mapping
from typing import Any, NamedTuple

from dora_systemd.names import is_readable
from dora_systemd.values import (
    INFINITY,
    SECOND,
    format_bool,
    format_cpu,
    format_duration,
    format_size,
    parse_bool,
    parse_cpu,
    parse_duration,
    parse_size,
)

_PART = r"""(?sx)
    (?P<blank> [ \t\n\r]+ )
    | " (?P<double> (?: [^"\\] | \\. )* ) "
    | ' (?P<single> (?: [^'\\] | \\. )* ) '
    | (?P<plain> (?: [^"'\\ \t\n\r] | \\. )+ )
    | (?P<unfinished> . )
    """
_ESCAPE = r"""(?sx)
    (?P<bytes> (?: \\[23][0-7]{2} | \\x[89a-fA-F][0-9a-fA-F] )+ )
    | \\ (?P<octal> [0-7]{3} )
    | \\ (?: x([0-9a-fA-F]{2}) | u([0-9a-fA-F]{4}) | U([0-9a-fA-F]{8}) )
    | \\ (?P<letter> . )
    """
_LETTERS = {"a": "\a", "b": "\b", "f": "\f", "n": "\n", "r": "\r", "t": "\t", "v": "\v", "s": " "}
_PLAIN_WORD = r"[A-Za-z0-9_@%=:,./+~^!?*\[\]-]+"
_NEEDS_ESCAPE = r'[\\"\x00-\x1f\x7f]'


def split_words(text: str) -> list[str]:
    """The words of `text`, split at blanks, with quotes and C escapes resolved.

    Raises ValueError for an unfinished quote or escape.
    """
    words: list[str] = []
    is_inside = False
    for part in re.finditer(_PART, text):
        name = part.lastgroup or ""
        if name == "unfinished":
            raise ValueError("a quote is not closed, or a backslash ends it")
        if name == "blank":
            is_inside = False
            continue
        words += [] if is_inside else [""]
        words[-1] += re.sub(_ESCAPE, _unescaped, part[name])
        is_inside = True
    return words


def escape_specifiers(text: str) -> str:
    """`text` with % doubled, because systemd.unit(5) expands specifiers."""
    return text.replace("%", "%%")


def quote_word(text: str) -> str:
    """`text` as one word of a list in a unit file, quoted and escaped if necessary."""
    escaped = escape_specifiers(text)
    if re.fullmatch(_PLAIN_WORD, escaped):
        return escaped
    return '"' + re.sub(_NEEDS_ESCAPE, _escaped, escaped) + '"'


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


SCALE = 2**32 - 1
"""100 % in the properties called ...Scale, which are relative to the machine's size."""

_SIGNED = r"[-+]?[0-9]{1,20}"
_DIGITS = r"[0-9]{1,19}"
_PERCENT = r"([0-9]{1,3}(?:\.[0-9]{1,2})?)%"
_CONTROL = r"[\x00-\x1f\x7f]"


class Property(NamedTuple):
    """One property as StartTransientUnit takes it; the bus adapter unpacks it as a tuple."""

    name: str  # on D-Bus, such as "TimeoutStopUSec"
    signature: str  # of D-Bus, such as "t"
    value: Any  # as the signature requires: int, bool, str, and sequences for arrays and structs


class PropertyKind(NamedTuple):
    """Functions to parse and format the values of a kind."""

    signature: str
    expected: str  # a description for hints
    parse: Callable[[str], Any]  # text to value; raises ValueError or DoraSystemdError
    # value to the text after "KEY="; after a newline, that of one more line with this key
    format: Callable[[Any], str]
    is_choice: bool = False  # one of some words, of which a newer systemd may have more


def plain_text(text: str) -> str:
    """`text` without surrounding blanks. Raises ValueError if a unit file cannot contain it."""
    stripped = text.strip()
    # A backslash at the end of a line would continue it.
    if re.search(_CONTROL, text) or not is_readable(text) or stripped.endswith("\\"):
        raise ValueError("control characters")
    return stripped


def word_kind(
    signature: str,
    words: Mapping[str, Any],
    numbers: Container[int] = (),
    expected: str = "",
    pattern: str = _DIGITS,
) -> PropertyKind:
    """Words for values, the first one of each value in unit files; `numbers` are valid as well.

    pattern: how a number is written. In LimitNICE= a sign has another meaning.
    """

    def parse(text: str) -> Any:
        word = text.strip()
        if word in words:
            return words[word]
        if not re.fullmatch(pattern, word) or int(word) not in numbers:
            raise ValueError("not a valid word or number")
        return int(word)

    known = "one of " + ", ".join(word for word in words if word)
    return PropertyKind(
        signature, expected or known, parse, lambda value: word_of(value, words, str(value))
    )


def word_of(value: Any, words: Mapping[str, Any], other: str) -> str:
    """The first word for `value`, or `other`."""
    return next((word for word, one in words.items() if one == value), other)


def number_kind(signature: str, lowest: int, highest: int) -> PropertyKind:
    """Integers between two bounds, inclusive."""
    expected = f"a whole number between {lowest} and {highest}"
    return word_kind(signature, {}, range(lowest, highest + 1), expected, _SIGNED)


def choice_kind(*choices: str) -> PropertyKind:
    """Return the kind of some words; with "yes" and "no", all boolean words are valid."""
    kind = word_kind("s", {choice: choice for choice in choices})._replace(is_choice=True)
    if not {"yes", "no"} <= {*choices}:
        return kind

    def parse(text: str) -> str:
        word = text.strip()
        return word if word in choices else format_bool(parse_bool(word))

    return kind._replace(parse=parse)


def file_kind(mode: str) -> PropertyKind:
    """MODE:/PATH, and only the path in the value."""

    def parse(text: str) -> str:
        given, _, path = plain_text(text).partition(":")
        if given != mode or not path.startswith("/"):
            raise ValueError("no such path")
        return path

    expected = f"{mode}:/PATH"
    return PropertyKind("s", expected, parse, lambda value: f"{mode}:{escape_specifiers(value)}")


def _parse_share(text: str) -> int:
    """A percentage as a part of SCALE, rounded so that steps of 0.01 % convert back exactly."""
    match = re.fullmatch(_PERCENT, text.strip())
    hundredths = round(float(match[1]) * 100) if match else -1
    if not 0 <= hundredths <= 10000:
        raise ValueError("not a percentage")
    return (hundredths * SCALE + 5000) // 10000


def _format_share(value: int) -> str:
    return f"{round(value * 10000 / SCALE) / 100:g}%"


def _parse_time(text: str, factor: int) -> int:
    """A bare number as it is, a time span in µs times `factor`."""
    if re.fullmatch(_DIGITS, text.strip()):
        return int(text)
    return min(factor * parse_duration(text), INFINITY)


def _parse_mode(text: str) -> int:
    if not re.fullmatch(r"[0-7]{1,5}", text.strip()) or int(text, 8) > 0o7777:
        raise ValueError("not a mode")
    return int(text, 8)


def _in_seconds(duration: int) -> int:
    return duration if duration == INFINITY else -(-duration // SECOND)


BOOL = PropertyKind("b", "yes or no", parse_bool, format_bool)
TEXT = PropertyKind("s", "one line of text", plain_text, escape_specifiers)
SIZE_LIMIT = PropertyKind(
    "t",
    "a size such as 512M, or infinity",
    lambda text: parse_size(text) if text.strip() else INFINITY,
    format_size,
)
COUNT_LIMIT = word_kind(
    "t", {"infinity": INFINITY, "": INFINITY}, range(10**19), "a number, or infinity"
)
SHARE = PropertyKind("u", "a percentage such as 50%", _parse_share, _format_share)
DURATION = PropertyKind(
    "t", "a time span such as 500ms, 10s or 1min 30s, or infinity", parse_duration, format_duration
)
NANOSECONDS = COUNT_LIMIT._replace(
    expected="nanoseconds, or a time span such as 50us",
    parse=lambda text: _parse_time(text, 1000),
)
SECONDS = COUNT_LIMIT._replace(
    expected="a time span such as 30s, or infinity",
    parse=lambda text: _in_seconds(parse_duration(text)),
)
MICROSECONDS = DURATION._replace(
    expected="a time span such as 100ms, or infinity",
    parse=lambda text: _parse_time(text, 1),
)
CPU_QUOTA = PropertyKind(
    "t",
    "a share of one CPU such as 150%, or infinity",
    lambda text: parse_cpu(text) if text.strip() else INFINITY,
    # In a unit file, an empty value means no quota.
    lambda value: "" if value == INFINITY else format_cpu(value),
)
WEIGHT = word_kind("t", {}, range(1, 10001), "a weight between 1 and 10000")
CPU_WEIGHT = word_kind("t", {"idle": 0}, range(1, 10001), "a weight between 1 and 10000, or idle")
MODE = PropertyKind("u", "an octal mode such as 0755", _parse_mode, "{:04o}".format)
