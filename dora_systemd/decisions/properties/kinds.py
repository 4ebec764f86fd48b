"""Kinds of unit property values: from text of `--property` to D-Bus and to unit files.

Types are those of org.freedesktop.systemd1(5), texts those of systemd-run(1).
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from dora_systemd.decisions.properties.syntax import escape_specifiers
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

SCALE = 2**32 - 1
"""100 % in the properties called ...Scale, which are relative to the machine's size."""

_NUMBER = re.compile(r"[-+]?[0-9]{1,20}")
_PERCENT = re.compile(r"([0-9]{1,3})(?:\.([0-9]{1,2}))?%")
_CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


class Property(NamedTuple):
    """One property as StartTransientUnit takes it; the bus adapter unpacks it as a tuple.

    name: on D-Bus, such as "TimeoutStopUSec". signature: of D-Bus, such as "t". value: as the
    signature requires: int, bool, str, and sequences for arrays and structs.
    """

    name: str
    signature: str
    value: Any


@dataclass(frozen=True)
class PropertyKind:
    """How a value is parsed and formatted.

    expected: a description for hints. parse: text to value; raises ValueError or DoraSystemdError.
    format: value to the texts after "KEY=", one for each line of the unit file.
    """

    signature: str
    expected: str
    parse: Callable[[str], Any]
    format: Callable[[Any], Sequence[str]]


def plain_text(text: str) -> str:
    """`text` without surrounding blanks. Raises ValueError if a unit file cannot contain it."""
    stripped = text.strip()
    # A backslash at the end of a line would continue it.
    if _CONTROL.search(text) or stripped.endswith("\\"):
        raise ValueError("control characters")
    return stripped


def number_kind(signature: str, lowest: int, highest: int) -> PropertyKind:
    """Integers between two bounds, inclusive."""

    def parse(text: str) -> int:
        if not _NUMBER.fullmatch(text.strip()) or not lowest <= int(text) <= highest:
            raise ValueError("not in range")
        return int(text)

    expected = f"a whole number between {lowest} and {highest}"
    return PropertyKind(signature, expected, parse, lambda value: [str(value)])


def choice_kind(*choices: str) -> PropertyKind:
    """One of some words; if "yes" and "no" are among them, all boolean words are valid."""
    kind = named_kind("s", {choice: choice for choice in choices})

    def parse(text: str) -> str:
        word = text.strip()
        if word not in choices and {"yes", "no"} <= set(choices):
            return format_bool(parse_bool(word))
        return str(kind.parse(word))

    return replace(kind, parse=parse)


def prefixed_path_kind(prefix: str) -> PropertyKind:
    """An absolute path after `prefix`, which is not part of the value."""

    def parse(text: str) -> str:
        path = plain_text(text).removeprefix(prefix)
        if not text.strip().startswith(prefix) or not path.startswith("/"):
            raise ValueError("no such path")
        return path

    def format_(value: str) -> Sequence[str]:
        return [prefix + escape_specifiers(value)]

    return PropertyKind("s", f"{prefix}/PATH", parse, format_)


def named_kind(signature: str, numbers: Mapping[str, Any], is_open: bool = False) -> PropertyKind:
    """A name for a value; with `is_open`, numbers are valid as well."""

    def parse(text: str) -> Any:
        word = text.strip()
        if is_open and word.isascii() and word.isdigit() and int(word[:9]) in numbers.values():
            return int(word[:9])
        if word not in numbers:
            raise ValueError("unknown word")
        return numbers[word]

    def format_(value: Any) -> Sequence[str]:
        return [next((word for word, one in numbers.items() if one == value), str(value))]

    expected = "one of " + ", ".join(word for word in numbers if word)
    return PropertyKind(signature, expected, parse, format_)


def _parse_share(text: str) -> int:
    """A percentage as a part of SCALE, rounded so that steps of 0.01 % convert back exactly."""
    match = _PERCENT.fullmatch(text.strip())
    hundredths = int(match[1]) * 100 + int((match[2] or "0").ljust(2, "0")) if match else -1
    if not 0 <= hundredths <= 10000:
        raise ValueError("not a percentage")
    return (hundredths * SCALE + 5000) // 10000


def _format_share(value: int) -> Sequence[str]:
    whole, hundredths = divmod((value * 10000 + SCALE // 2) // SCALE, 100)
    return [f"{whole}.{hundredths:02}".rstrip("0").rstrip(".") + "%"]


def _parse_limit(text: str) -> int:
    return parse_size(text) if text.strip() else INFINITY


def _parse_count(text: str) -> int:
    if text.strip() in ("", "infinity"):
        return INFINITY
    return _parse_natural(text)


def _parse_natural(text: str) -> int:
    if not text.strip().isascii() or not text.strip().isdigit() or len(text) > 19:
        raise ValueError("not a number")
    return int(text)


def _parse_weight(text: str) -> int:
    value = _parse_natural(text)
    if not 1 <= value <= 10000:
        raise ValueError("not in range")
    return value


def _parse_mode(text: str) -> int:
    if not re.fullmatch(r"[0-7]{1,5}", text.strip()) or int(text, 8) > 0o7777:
        raise ValueError("not a mode")
    return int(text, 8)


def _in_seconds(duration: int) -> int:
    return duration if duration == INFINITY else -(-duration // SECOND)


def _format_count(value: int) -> Sequence[str]:
    return ["infinity" if value == INFINITY else str(value)]


BOOL = PropertyKind("b", "yes or no", parse_bool, lambda value: [format_bool(value)])
TEXT = PropertyKind("s", "one line of text", plain_text, lambda value: [escape_specifiers(value)])
SIZE_LIMIT = PropertyKind(
    "t",
    "a size such as 512M, or infinity",
    _parse_limit,
    lambda value: [format_size(value)],
)
COUNT_LIMIT = PropertyKind("t", "a number, or infinity", _parse_count, _format_count)
SHARE = PropertyKind("u", "a percentage such as 50%", _parse_share, _format_share)
DURATION = PropertyKind(
    "t",
    "a time span such as 500ms, 10s or 1min 30s, or infinity",
    parse_duration,
    lambda value: [format_duration(value)],
)
NANOSECONDS = PropertyKind(
    "t",
    "nanoseconds, or a time span such as 50us",
    lambda text: _parse_natural(text) if text.strip().isdigit() else 1000 * parse_duration(text),
    lambda value: [str(value)],
)
SECONDS = PropertyKind(
    "t",
    "a time span such as 30s, or infinity",
    lambda text: _in_seconds(parse_duration(text)),
    _format_count,
)
MICROSECONDS = PropertyKind(
    "t",
    "a time span such as 100ms, or infinity",
    lambda text: _parse_natural(text) if text.strip().isdigit() else parse_duration(text),
    lambda value: ["0"] if value == 0 else [format_duration(value)],
)
CPU_QUOTA = PropertyKind(
    "t",
    "a share of one CPU such as 150%, or infinity",
    lambda text: parse_cpu(text) if text.strip() else INFINITY,
    # In a unit file, an empty value means no quota.
    lambda value: ["" if value == INFINITY else format_cpu(value)],
)
WEIGHT = PropertyKind(
    "t", "a weight between 1 and 10000", _parse_weight, lambda value: [str(value)]
)
CPU_WEIGHT = PropertyKind(
    "t",
    "a weight between 1 and 10000, or idle",
    lambda text: 0 if text.strip() == "idle" else _parse_weight(text),
    lambda value: [str(value) if value else "idle"],
)
MODE = PropertyKind("u", "an octal mode such as 0755", _parse_mode, lambda value: [f"{value:04o}"])
