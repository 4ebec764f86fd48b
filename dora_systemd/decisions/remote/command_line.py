"""Takes -H out of a command line, as click would read it. Pure."""

from collections.abc import Callable, Iterator, Sequence, Set
from typing import NamedTuple

from dora_systemd.errors import usage_error

SHORT, LONG = "-H", "--host"


class Parted(NamedTuple):
    """A command line."""

    hosts: list[str]  # the values of its -H options
    words: list[str]  # all the others


def part_hosts(words: Sequence[str], valued_of: Callable[[str], Set[str]]) -> Parted:
    """Take -H out of `words`, before and after the verb.

    valued_of: the options of a verb that have a value, which may look like an option.
    Raises DoraSystemdError (USAGE) for one without a value.
    """
    parted, valued, has_verb = Parted([], []), frozenset[str](), False
    rest = iter(words)
    for word in rest:
        if word == "--":
            parted.words.extend((word, *rest))
        elif len(word) < 2 or word[0] != "-":
            valued = valued if has_verb else frozenset(valued_of(word))
            has_verb = True
            parted.words.append(word)
        elif word.startswith("--"):
            _take_long(word, rest, valued, parted)
        else:
            _take_short(word, rest, valued, parted)
    return parted


def _take_long(word: str, rest: Iterator[str], valued: Set[str], parted: Parted) -> None:
    name, equals, value = word.partition("=")
    if name == LONG:
        parted.hosts.append(value if equals else _next(rest, LONG))
        return
    parted.words.append(word)
    if name in valued and not equals:
        parted.words.extend(_at_most_one(rest))


def _take_short(word: str, rest: Iterator[str], valued: Set[str], parted: Parted) -> None:
    """Parse combined letters: the first letter with a value takes the rest of the word."""
    for place, letter in enumerate(word[1:], 1):
        value = word[place + 1 :]
        if f"-{letter}" == SHORT:
            parted.words.extend([word[:place]] if place > 1 else [])
            parted.hosts.append(value or _next(rest, SHORT))
            return
        if f"-{letter}" in valued:
            parted.words.extend([word, *(() if value else _at_most_one(rest))])
            return
    parted.words.append(word)


def without_flag(words: Sequence[str], flag: str, long: str, valued: Set[str]) -> list[str]:
    """The command line of a verb without a flag, such as -q or --quiet.

    valued: the options that have a value.
    """
    kept: list[str] = []
    rest = iter(words)
    for word in rest:
        if word == "--":
            kept.extend((word, *rest))
        elif word.startswith("--") or word[:1] != "-" or word == "-":
            kept.extend([] if word == long else [word])
            kept.extend(_at_most_one(rest) if word in valued else ())
        else:
            letters, has_value = _without_letter(word[1:], flag[1:], valued)
            kept.extend([f"-{letters}"] if letters else [])
            kept.extend(_at_most_one(rest) if has_value else ())
    return kept


def _without_letter(letters: str, unwanted: str, valued: Set[str]) -> tuple[str, bool]:
    """Some flags without one of them, and whether the next word is the value of the last."""
    kept = ""
    for place, letter in enumerate(letters):
        if f"-{letter}" in valued:
            return kept + letters[place:], place == len(letters) - 1
        kept += "" if letter == unwanted else letter
    return kept, False


def _at_most_one(rest: Iterator[str]) -> list[str]:
    return [word for word in [next(rest, None)] if word is not None]


def _next(rest: Iterator[str], option: str) -> str:
    value = next(rest, None)
    if value is None:
        hint = "[user@]HOST, several with commas, or all"
        raise usage_error(f"option {option} requires a host", hint)
    return value


def with_output(words: Sequence[str], form: str) -> list[str]:
    """The command line with `-o form`: the last one counts."""
    return with_options(words, "-o", form)


def with_options(words: Sequence[str], *options: str) -> list[str]:
    """The command line with these options of the verb."""
    end = words.index("--") if "--" in words else len(words)
    return [*words[:end], *options, *words[end:]]
