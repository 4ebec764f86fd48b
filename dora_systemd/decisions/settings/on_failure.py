"""The setting `on_failure`: what runs when a dataflow has failed."""

from pathlib import PurePath
from typing import Any

from dora_systemd.decisions.notice.command import UNIT, checked_words, format_words, parse_words
from dora_systemd.decisions.settings.kinds import Base, Kind, Setting, texts_of
from dora_systemd.values import scalar_text


def _parse(value: Any, base: Base) -> tuple[str, ...]:
    is_list = isinstance(value, list | tuple)
    words = checked_words(texts_of(value)) if is_list else parse_words(scalar_text(value))
    has_path = base is not None and "/" in words[0] and not words[0].startswith(UNIT)
    return (str(PurePath(base or "", words[0])), *words[1:]) if has_path else words


ON_FAILURE = Setting[tuple[str, ...]](
    "on_failure",
    Kind[tuple[str, ...]](
        str | list[str],
        "a command such as [notify, --urgent], or unit:NAME.service",
        _parse,
        lambda words: [format_words(words)] if words else [],
        metavar="COMMAND",
    ),
    (),
    "Command, or unit:NAME, that runs when the dataflow fails, or a node is given up.",
    # systemd starts such a unit with the rights that the unit has.
    raises=lambda words: bool(words) and words[0].startswith(UNIT),
)
NOTICE_SETTINGS: tuple[Setting[Any], ...] = (ON_FAILURE,)
RUNNER_SETTINGS = {ON_FAILURE.name: ON_FAILURE}
