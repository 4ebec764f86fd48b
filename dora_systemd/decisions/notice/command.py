"""The command of the setting `on_failure`: words for execve(2), or a unit. No shell reads it."""

import re
import shlex
from collections.abc import Sequence

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import NOTICE_PREFIX, UNIT_PREFIX, is_readable
from dora_systemd.values import quoted

Words = tuple[str, ...]

UNIT = "unit:"
_UNIT_NAME = r"[A-Za-z0-9:_.\\-]{1,200}(@[A-Za-z0-9:_.\\-]{0,200})?\.service"
_MOST_BYTES = 64 * 1024


def parse_words(text: str) -> Words:
    """The words of a text, split as a shell does, but nothing in them is expanded.

    Raises DoraSystemdError (USAGE).
    """
    try:
        return checked_words(shlex.split(text))
    except ValueError as error:
        raise _refusal(text, "close the quotation mark, or write a list of words") from error


def format_words(words: Words) -> str:
    """The text from which parse_words() makes the same words."""
    return shlex.join(words)


def checked_words(words: Sequence[str]) -> Words:
    """The words of a command, or one word that names a unit. Raises DoraSystemdError (USAGE)."""
    text = " ".join(words)
    if not words or not words[0].strip():
        raise _refusal(text, "write a program and its arguments, or unit:NAME.service")
    if not (text.isprintable() and is_readable(text)) or len(text.encode()) > _MOST_BYTES:
        raise _refusal(text, "a word is plain text on one line, and all have at most 64 KiB")
    if words[0].startswith(UNIT):
        _check_unit(words, words[0].removeprefix(UNIT))
    return tuple(words)


def _check_unit(words: Sequence[str], unit: str) -> None:
    if len(words) > 1 or not re.fullmatch(_UNIT_NAME, unit):
        raise _refusal(" ".join(words), "write unit:NAME.service, or unit:NAME@.service")
    if unit.startswith((UNIT_PREFIX, NOTICE_PREFIX)):
        raise _refusal(words[0], "a failure must not start a unit of dora-systemd")


def words_of(options: RunnerOptions) -> Words:
    """The command of a notice, or a unit; () for no notice. Raises DoraSystemdError."""
    words: Words = options.of_dataflow("on_failure") if options.has("on_failure") else ()
    return words


def is_command(words: Words) -> bool:
    """Whether they are the words of a command, and neither () nor a unit."""
    return bool(words) and not words[0].startswith(UNIT)


def unit_of(words: Words, name: str) -> str:
    """The unit that a notice of the dataflow `name` starts, or "" if it runs a command.

    A template gets the name of the dataflow as its instance.
    """
    if not words or is_command(words):
        return ""
    unit = words[0].removeprefix(UNIT)
    return unit.replace("@.service", f"@{name}.service")


def _refusal(text: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot use {quoted(text)} as on_failure", hint)
