"""The settings `on_failure` and `black_box`: what follows when a dataflow has failed."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from dora_systemd.decisions.cell.black_box import (
    BlackBox,
    black_box_of,
    format_black_box,
    parse_black_box,
)
from dora_systemd.decisions.notice.command import UNIT, checked_words, format_words, parse_words
from dora_systemd.decisions.settings.kinds import Base, Kind, Scalar, Setting, texts_of
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


def _parse_box(value: Any, _: Base) -> BlackBox | None:
    if not isinstance(value, Mapping):
        return parse_black_box(scalar_text(value))
    return black_box_of({key: scalar_text(one) for key, one in value.items()})


BLACK_BOX = Setting[BlackBox | None](
    "black_box",
    Kind[BlackBox | None](
        Scalar | dict[str, Scalar],
        "{keep: 5, size: 100M}, yes or no",
        _parse_box,
        lambda box: [format_black_box(box)],
        metavar="keep=N,size=SIZE",
    ),
    None,
    "Write a bundle after each failure; how many are kept, and their size together.",
    on_members=False,
)
NOTICE_SETTINGS: tuple[Setting[Any], ...] = (ON_FAILURE, BLACK_BOX)
RUNNER_SETTINGS = {one.name: one for one in NOTICE_SETTINGS}
