"""Defines settings, and the kinds of their values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Generic, TypeVar

from dora_systemd.decisions.cell.environment import (
    checked_variable,
    environment_entries,
    parse_assignment,
)
from dora_systemd.decisions.cell.line_rates import RateLimits, format_rates, parse_rates
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import (
    format_bool,
    format_duration,
    parse_bool,
    parse_duration,
    quoted,
)

T = TypeVar("T")
Scalar = str | int | float | bool
Base = PurePath | None
"""The directory that relative paths start from, or None to keep them relative."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """One kind of value.

    schema: what a settings file may contain, as a type for pydantic.
    expected: the same in words, for messages.
    parse: from the text of a flag or variable, a sequence of texts, or a settings file's value.
    format: the text from which parse makes the same value; several texts for repeatable kinds.
    is_flag: `--x` and `--no-x` without a value.
    is_repeatable: the flag may be given more than once.
    merge: joins the values of two sources, higher precedence last; None: only the latter counts.
    """

    schema: Any
    expected: str
    parse: Callable[[Any, Base], T]
    format: Callable[[T], Sequence[str]]
    is_flag: bool = False
    is_repeatable: bool = False
    merge: Callable[[T, T], T] | None = None


@dataclass(frozen=True)
class Setting(Generic[T]):
    """One setting.

    name: its key in settings files.
    help: one sentence, for --help and the manual.
    flags: its options, the long one first; a kind with is_flag has `--no-...` as well.
    variable: the environment variable, or "".
    per_node: also valid below `nodes: NODE:` in a settings file.
    property: the systemd property with the same value, as in a unit file, or "".
    root_only: the setting makes root read, run or grant something. In system scope it is only valid
    in a settings file that root alone can have written.
    """

    name: str
    kind: Kind[Any]
    default: T
    help: str
    flags: tuple[str, ...] = ()
    variable: str = ""
    metavar: str = ""
    per_node: bool = False
    property: str = ""
    root_only: bool = False


def scalar_text(value: Scalar) -> str:
    """A YAML scalar as the author sees it: true, 1, 0.5, text."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _parse_text(value: Scalar, base: Base) -> str:
    del base
    text = scalar_text(value)
    if not text.strip() or not text.isprintable():
        hint = "write one line of plain text"
        raise DoraSystemdError(f"cannot read {quoted(text)} as a text", hint, ExitCode.USAGE)
    return text


def _parse_path(value: Scalar, base: Base) -> str:
    text = _parse_text(value, None)
    return str(base / text) if base else text


def _parse_program(value: Scalar, base: Base) -> str:
    """A path, or a program name to look up in PATH."""
    text = _parse_text(value, None)
    return _parse_path(text, base) if "/" in text else text


def texts_of(value: Any) -> Sequence[Any]:
    """The values of a repeatable flag or a settings file: a list, or a single value."""
    return value if isinstance(value, list | tuple) else [value]


def _parse_paths(value: Any, base: Base) -> tuple[str, ...]:
    return tuple(_parse_path(one, base) for one in texts_of(value))


def _parse_environment(value: Any, base: Base) -> Mapping[str, str]:
    del base
    if isinstance(value, Mapping):
        return dict(checked_variable(key, scalar_text(one)) for key, one in value.items())
    return dict(parse_assignment(scalar_text(one)) for one in texts_of(value))


def _parse_properties(value: Any, base: Base) -> tuple[str, ...]:
    """Assignments KEY=VALUE; the table of properties parses the values."""
    del base
    if isinstance(value, Mapping):
        return tuple(
            f"{key}={_property_text(one)}" for key, many in value.items() for one in texts_of(many)
        )
    return tuple(scalar_text(one) for one in texts_of(value))


def _property_text(value: Scalar) -> str:
    return format_bool(value) if isinstance(value, bool) else str(value)


TEXT = Kind[str](Scalar, "a text", _parse_text, lambda value: [value])
PATH = Kind[str](str, "a path", _parse_path, lambda value: [value])
PROGRAM = Kind[str](str, "a program", _parse_program, lambda value: [value])
BOOL = Kind[bool](
    bool | str,
    "yes or no",
    lambda value, _: parse_bool(scalar_text(value)),
    lambda value: [format_bool(value)],
    is_flag=True,
)
DURATION = Kind[int](
    str | int | float,
    "a time span such as 10s",
    lambda value, _: parse_duration(scalar_text(value)),
    lambda value: [format_duration(value)],
)
PATHS = Kind[tuple[str, ...]](
    str | list[str],
    "a path or a list of paths",
    _parse_paths,
    list,
    is_repeatable=True,
    merge=lambda lower, higher: lower + higher,
)
ENVIRONMENT = Kind[Mapping[str, str]](
    dict[str, Scalar] | list[str],
    "a mapping, KEY: VALUE",
    _parse_environment,
    environment_entries,
    is_repeatable=True,
    merge=lambda lower, higher: {**lower, **higher},
)
PROPERTIES = Kind[tuple[str, ...]](
    dict[str, Scalar | list[Scalar]] | list[str],
    "a mapping, PROPERTY: VALUE",
    _parse_properties,
    list,
    is_repeatable=True,
    merge=lambda lower, higher: lower + higher,
)
LINE_RATES = Kind[RateLimits](
    str | list[str],
    "LINES/TIME such as 1000/1s",
    lambda value, _: parse_rates(map(scalar_text, texts_of(value))),
    format_rates,
    is_repeatable=True,
    merge=lambda lower, higher: {**lower, **higher},
)
