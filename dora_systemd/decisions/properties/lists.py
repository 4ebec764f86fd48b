"""Property kinds whose values are lists of words: names, environments, filters, conditions.

An empty text is an empty list, which resets the property, as an empty value does in a unit file.
"""

import re
from collections.abc import Sequence

from dora_systemd.decisions.cell.environment import parse_assignment
from dora_systemd.decisions.properties.kinds import PropertyKind, plain_text
from dora_systemd.decisions.properties.syntax import escape_specifiers, quote_word, split_words

Condition = tuple[str, bool, bool, str]

_FIELD = re.compile(r"[A-Z0-9][A-Z0-9_]{0,63}=")


def parse_words(text: str) -> tuple[str, ...]:
    """The words of a list, unquoted. Raises ValueError if a unit file cannot contain them."""
    return tuple(plain_text(word) for word in split_words(plain_text(text)))


def format_words(words: Sequence[str]) -> Sequence[str]:
    """All words on one line."""
    return [" ".join(quote_word(word) for word in words)]


def lines(texts: Sequence[str]) -> Sequence[str]:
    """One line for each text, or an empty line, which resets the list."""
    return list(texts) or [""]


def _parse_environment(text: str) -> tuple[str, ...]:
    return tuple("=".join(parse_assignment(word)) for word in split_words(text))


def _parse_filter(text: str) -> tuple[bool, tuple[str, ...]]:
    given = plain_text(text)
    words = parse_words(given.removeprefix("~"))
    if words and words[0].startswith("~"):
        raise ValueError("only one ~ may stand in front")  # a unit file would take it for the first
    return not given.startswith("~"), words


def _format_filter(value: tuple[bool, Sequence[str]]) -> Sequence[str]:
    is_allowed, words = value
    return [("" if is_allowed else "~") + format_words(words)[0]]


def _parse_profile(text: str) -> tuple[bool, str]:
    name = plain_text(text)
    return name.startswith("-"), name.removeprefix("-")


def _format_profile(value: tuple[bool, str]) -> Sequence[str]:
    is_optional, name = value
    return [("-" if is_optional else "") + escape_specifiers(name)]


def _parse_fields(text: str) -> tuple[bytes, ...]:
    """One field as for systemd-run, or several quoted ones as in unit files."""
    field = plain_text(text)
    fields = parse_words(field) if field.startswith('"') else (field,) if field else ()
    if not all(_FIELD.match(one) for one in fields):
        raise ValueError("not a field")
    return tuple(one.encode() for one in fields)


def _format_fields(value: Sequence[bytes]) -> Sequence[str]:
    return lines([quote_word(field.decode()) for field in value])


def _parse_pattern(text: str) -> tuple[tuple[bool, str], ...]:
    pattern = plain_text(text)
    return ((not pattern.startswith("~"), pattern.removeprefix("~")),) if pattern else ()


def _format_patterns(value: Sequence[tuple[bool, str]]) -> Sequence[str]:
    return lines([("" if is_kept else "~") + escape_specifiers(text) for is_kept, text in value])


def condition_kind(name: str) -> PropertyKind:
    """`Condition...=` and `Assert...=` of systemd.unit(5); "|" triggers and "!" negates."""

    def parse(text: str) -> tuple[Condition, ...]:
        condition = plain_text(text)
        rest = condition.removeprefix("|")
        parameter = rest.removeprefix("!")
        is_trigger, is_negated = rest != condition, parameter != rest
        return ((name, is_trigger, is_negated, parameter),) if condition else ()

    return PropertyKind("a(sbbs)", "a condition, such as !/run/stop", parse, _format_conditions)


def _format_conditions(value: Sequence[Condition]) -> Sequence[str]:
    return lines(
        [
            "|" * is_trigger + "!" * is_negated + escape_specifiers(parameter)
            for _, is_trigger, is_negated, parameter in value
        ]
    )


def _parse_search_path(text: str) -> tuple[str, ...]:
    paths = tuple(path for word in parse_words(text) for path in word.split(":") if path)
    # Quotes in a path would need another level of quoting; no real directory has them.
    if any(not path.startswith("/") or set(path) & set("\"'\\ \t\n") for path in paths):
        raise ValueError(text)
    return paths


WORDS = PropertyKind("as", "words separated by blanks", parse_words, format_words)
SEARCH_PATH = PropertyKind(
    "as",
    "absolute paths with colons between them",
    _parse_search_path,
    lambda value: [escape_specifiers(":".join(value))],
)
ENVIRONMENT = PropertyKind(
    "as",
    "assignments KEY=VALUE, in quotes where they hold blanks",
    _parse_environment,
    lambda value: lines([quote_word(entry) for entry in value]),
)
FILTER = PropertyKind(
    "(bas)", "names, or ~ and the names to leave out", _parse_filter, _format_filter
)
PROFILE = PropertyKind("(bs)", "the name of a profile", _parse_profile, _format_profile)
FIELDS = PropertyKind("aay", "a journal field FIELD=VALUE", _parse_fields, _format_fields)
PATTERNS = PropertyKind(
    "a(bs)", "a pattern, or ~ and one that drops lines", _parse_pattern, _format_patterns
)
