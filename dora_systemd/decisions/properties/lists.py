"""Property kinds whose values are lists of words: names, environments, filters, conditions.

An empty text is an empty list, which resets the property, as an empty value does in a unit file.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any

from dora_systemd.decisions.cell.environment import parse_assignment
from dora_systemd.decisions.properties.kinds import (
    PropertyKind,
    escape_specifiers,
    plain_text,
    quote_word,
    split_words,
)

Condition = tuple[str, bool, bool, str]

_FIELD = r"[A-Z0-9][A-Z0-9_]{0,63}="


def words_kind(
    signature: str, expected: str, parse: Callable[[str], Any], format_: Callable[[Any], str]
) -> PropertyKind:
    """Quoted words on one line; `parse` and `format_` are for one of them."""

    def parse_words(text: str) -> tuple[Any, ...]:
        return tuple(parse(plain_text(word)) for word in split_words(plain_text(text)))

    return PropertyKind(
        signature, expected, parse_words, lambda words: " ".join(map(format_, words))
    )


def items_kind(
    signature: str, expected: str, parse: Callable[[str], Any], format_: Callable[[Any], str]
) -> PropertyKind:
    """Lines with one item each; `parse` and `format_` are for one of them."""

    def parse_items(text: str) -> tuple[Any, ...]:
        item = plain_text(text)
        return (parse(item),) if item else ()

    return PropertyKind(
        signature, expected, parse_items, lambda items: "\n".join(map(format_, items))
    )


def condition_kind(name: str) -> PropertyKind:
    """`Condition...=` and `Assert...=` of systemd.unit(5); "|" triggers and "!" negates."""

    def parse(text: str) -> Condition:
        is_trigger, rest = marked("|", text)
        return name, is_trigger, *marked("!", rest)

    return items_kind("a(sbbs)", "a condition, such as !/run/stop", parse, _format_condition)


def marked(mark: str, text: str) -> tuple[bool, str]:
    """Whether `text` begins with `mark`, and the rest."""
    return text.startswith(mark), text.removeprefix(mark)


def _format_condition(condition: Condition) -> str:
    _, is_trigger, is_negated, parameter = condition
    return "|" * is_trigger + "!" * is_negated + escape_specifiers(parameter)


def _parse_environment(text: str) -> tuple[str, ...]:
    return tuple("=".join(parse_assignment(word)) for word in split_words(text))


def _parse_filter(text: str) -> tuple[bool, tuple[str, ...]]:
    is_denied, names = marked("~", plain_text(text))
    words = WORDS.parse(names)
    if words and words[0].startswith("~"):
        raise ValueError("only one ~ may stand in front")  # a unit file would take it for the first
    return not is_denied, words


def _format_filter(value: tuple[bool, Sequence[str]]) -> str:
    is_allowed, words = value
    return "~" * (not is_allowed) + WORDS.format(words)


def _parse_fields(text: str) -> tuple[bytes, ...]:
    """Parse one field as for systemd-run, or several quoted fields as in unit files."""
    field = plain_text(text)
    fields = WORDS.parse(field) if field.startswith('"') else (field,) if field else ()
    if not all(re.match(_FIELD, one) for one in fields):
        raise ValueError("not a field")
    return tuple(one.encode() for one in fields)


def _parse_search_path(text: str) -> tuple[str, ...]:
    paths = tuple(path for word in WORDS.parse(text) for path in word.split(":") if path)
    # Quotes in a path would need another level of quoting; no real directory has them.
    if any(not path.startswith("/") or set(path) & set("\"'\\ \t\n") for path in paths):
        raise ValueError(text)
    return paths


WORDS = words_kind("as", "words separated by blanks", str, quote_word)
SEARCH_PATH = PropertyKind(
    "as",
    "absolute paths with colons between them",
    _parse_search_path,
    lambda value: escape_specifiers(":".join(value)),
)
ENVIRONMENT = PropertyKind(
    "as",
    "assignments KEY=VALUE, in quotes where they hold blanks",
    _parse_environment,
    lambda value: "\n".join(map(quote_word, value)),
)
FILTER = PropertyKind(
    "(bas)", "names, or ~ and the names to leave out", _parse_filter, _format_filter
)
PROFILE = PropertyKind(
    "(bs)",
    "the name of a profile",
    lambda text: marked("-", plain_text(text)),
    lambda value: "-" * value[0] + escape_specifiers(value[1]),
)
FIELDS = PropertyKind(
    "aay",
    "a journal field FIELD=VALUE",
    _parse_fields,
    lambda value: "\n".join(quote_word(field.decode()) for field in value),
)
PATTERNS = items_kind(
    "a(bs)",
    "a pattern, or ~ and one that drops lines",
    lambda text: (not text.startswith("~"), text.removeprefix("~")),
    lambda one: "~" * (not one[0]) + escape_specifiers(one[1]),
)
