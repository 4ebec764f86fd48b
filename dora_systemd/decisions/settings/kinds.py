"""What a setting is, and the kinds of values that settings have."""

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
"""The directory that relative paths start from, or None to leave them alone."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """One kind of value.

    schema: what a settings file may hold, as a type for pydantic.
    expected: the same in words, for messages.
    parse: from a flag's or variable's text, a sequence of such texts, or a settings file's value.
    format: the text that parse gives the same value for, or one text each for repeatable kinds.
    is_flag: `--x` and `--no-x` without a value.
    is_repeatable: the flag may be given more than once.
    merge: the value of a less and of a more important source in one; None: the latter alone holds.
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
    per_node: may stand below `nodes: NODE:` of a settings file too.
    property: the systemd property it becomes as it is, as in a unit file, or "".
    root_only: whoever sets it has root read, run or give something: in system scope a settings
        file may hold it only if root alone can have written it.
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
    """A scalar of YAML as the text that its author sees: true, 1, 0.5, text."""
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
    """A path, or a bare name that is looked up in PATH."""
    text = _parse_text(value, None)
    return _parse_path(text, base) if "/" in text else text


def texts_of(value: Any) -> Sequence[Any]:
    """What a repeatable flag or a settings file gives: many values, or one that stands alone."""
    return value if isinstance(value, list | tuple) else [value]


def _parse_paths(value: Any, base: Base) -> tuple[str, ...]:
    return tuple(_parse_path(one, base) for one in texts_of(value))


def _parse_environment(value: Any, base: Base) -> Mapping[str, str]:
    del base
    if isinstance(value, Mapping):
        return dict(checked_variable(key, scalar_text(one)) for key, one in value.items())
    return dict(parse_assignment(scalar_text(one)) for one in texts_of(value))


def _parse_properties(value: Any, base: Base) -> tuple[str, ...]:
    """Assignments KEY=VALUE; the values themselves are read by the table of properties."""
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
