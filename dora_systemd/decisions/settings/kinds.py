"""Defines settings, and the kinds of their values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import add, or_
from pathlib import PurePath
from typing import Any, Generic, TypeVar

from dora_systemd.decisions.cell.environment import (
    checked_variable,
    environment_entries,
    parse_assignment,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.errors import usage_error
from dora_systemd.values import (
    format_bool,
    format_duration,
    parse_bool,
    parse_duration,
    quoted,
    scalar_text,
)

T = TypeVar("T")
Scalar = str | int | float | bool
Base = PurePath | None
"""The directory that relative paths start from, or None to keep them relative."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """One kind of value."""

    schema: Any  # what a settings file may contain, as a type for pydantic
    expected: str  # the accepted texts, for messages
    # from the text of a flag or variable, a sequence of texts, or a settings file's value
    parse: Callable[[Any, Base], T]
    # the text from which parse makes the same value; several texts for repeatable kinds
    format: Callable[[T], Sequence[str]]
    is_flag: bool = False  # `--x` and `--no-x` without a value
    is_repeatable: bool = False  # the flag may be given more than once
    # joins the values of two sources, higher precedence last; None: only the latter counts
    merge: Callable[[T, T], T] | None = None
    metavar: str = ""  # the value in --help, such as TIME; a setting may have a better one
    # the keys, if a value can be a mapping; as text it is KEY=VALUE,KEY=VALUE
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class Setting(Generic[T]):
    """One setting."""

    name: str  # its key in settings files
    kind: Kind[Any]
    default: T
    help: str  # one sentence, for --help and the manual
    # its options, the long one first; a kind with is_flag has `--no-...` as well. Without any it is
    # the name with "-" for "_".
    flags: tuple[str, ...] = ()
    # the environment variable. Without one it is DORA_ and the name, or for a repeatable kind there
    # is none.
    variable: str = ""
    metavar: str = ""
    per_node: bool = False  # also valid below `nodes: NODE:` in a settings file
    property: str = ""  # the systemd property with the same value, as in a unit file, or ""
    # the setting makes root read, run or grant something. In system scope it is only valid in a
    # settings file that root alone can have written.
    root_only: bool = False
    only_nodes: bool = False  # only valid below `nodes: NODE:`, so there is no flag and no variable
    # whether a value, of a node or of the dataflow, gives more than the user of the dataflow has.
    # In system scope such a value is only valid where root_only settings are.
    raises: Callable[[Any], bool] | None = None
    # on_head: of several machines the head obeys it also for nodes of its members; on_members: they
    # obey it for their own nodes
    on_head: bool = False
    on_members: bool = True
    # a hot reload may remove a node with a value; a limit could be for a node that was renamed
    outlives_node: bool = False
    # of the values of nodes, if they have another one; then the runner gets only those
    node_kind: Kind[Any] | None = None
    # makes of a value what the runner gets, when the working directory is known
    at_start: Callable[[Any, str], Any] | None = None
    # raises DoraSystemdError (BAD_INPUT) for values in the options of a runner that these nodes of
    # the dataflow cannot have
    check: Callable[[RunnerOptions, Sequence[Node]], None] | None = None

    def __post_init__(self) -> None:
        word = self.name.replace("_", "-")
        variable = "" if self.kind.is_repeatable else f"DORA_{self.name.upper()}"
        if self.only_nodes:
            object.__setattr__(self, "per_node", True)
            return
        object.__setattr__(self, "flags", self.flags or (f"--{word}",))
        object.__setattr__(self, "variable", self.variable or variable)
        object.__setattr__(self, "metavar", self.metavar or self.kind.metavar)

    def of_node(self) -> Kind[Any]:
        """The kind of the values of nodes."""
        return self.node_kind or self.kind

    def read(self, texts: Sequence[str]) -> T:
        """The value that Kind.format has made `texts` of. Raises DoraSystemdError."""
        kind = self.of_node()
        value: T = kind.parse(list(texts) if kind.is_repeatable else texts[-1], None)
        return value


def listed(value: Any) -> Sequence[Any]:
    """The values of a repeatable flag or a settings file: a list, or a single value."""
    return value if isinstance(value, list | tuple) else [value]


def texts_of(value: Any) -> list[str]:
    """Return a value as texts."""
    return list(map(scalar_text, listed(value)))


def one_text(
    schema: Any,
    expected: str,
    metavar: str,
    parse: Callable[[str], T],
    to_text: Callable[[T], str] = str,
) -> Kind[T]:
    """A kind with one text for each value, which means the same in every directory."""
    return Kind(
        schema,
        expected,
        lambda value, _: parse(scalar_text(value)),
        lambda value: [to_text(value)],
        metavar=metavar,
    )


def many_texts(
    expected: str,
    metavar: str,
    parse: Callable[[list[str]], T],
    to_texts: Callable[[T], Sequence[str]],
    merge: Callable[[T, T], T] | None = None,
) -> Kind[T]:
    """A repeatable kind of texts, which mean the same in every directory."""
    return Kind(
        str | list[str],
        expected,
        lambda value, _: parse(texts_of(value)),
        to_texts,
        is_repeatable=True,
        merge=merge,
        metavar=metavar,
    )


def _checked_text(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise usage_error(f"cannot read {quoted(text)} as a text", "write one line of plain text")
    return text


def _parse_path(value: Scalar, base: Base) -> str:
    text = _checked_text(scalar_text(value))
    return str(base / text) if base else text


def _parse_program(value: Scalar, base: Base) -> str:
    """A path, or a program name to look up in PATH."""
    return _parse_path(value, base if "/" in scalar_text(value) else None)


def _parse_paths(value: Any, base: Base) -> tuple[str, ...]:
    return tuple(_parse_path(one, base) for one in texts_of(value))


def _parse_environment(value: Any, _: Base) -> Mapping[str, str]:
    if isinstance(value, Mapping):
        return dict(checked_variable(key, scalar_text(one)) for key, one in value.items())
    return dict(map(parse_assignment, texts_of(value)))


def _parse_properties(value: Any, _: Base) -> tuple[str, ...]:
    """Assignments KEY=VALUE; the table of properties parses the values."""
    if isinstance(value, Mapping):
        return tuple(
            f"{key}={_property_text(one)}" for key, many in value.items() for one in listed(many)
        )
    return tuple(texts_of(value))


def _property_text(value: Scalar) -> str:
    return format_bool(value) if isinstance(value, bool) else str(value)


TEXT = one_text(Scalar, "a text", "TEXT", _checked_text)
PATH = Kind[str](str, "a path", _parse_path, lambda value: [value])
PROGRAM = Kind[str](str, "a program", _parse_program, lambda value: [value], metavar="FILE")
BOOL = replace(one_text(bool | str, "yes or no", "", parse_bool, format_bool), is_flag=True)
DURATION = one_text(
    str | int | float, "a time span such as 10s", "TIME", parse_duration, format_duration
)
PATHS = Kind[tuple[str, ...]](
    str | list[str], "a path or a list of paths", _parse_paths, list, is_repeatable=True, merge=add
)
ENVIRONMENT = Kind[Mapping[str, str]](
    dict[str, Scalar] | list[str],
    "a mapping, KEY: VALUE",
    _parse_environment,
    environment_entries,
    is_repeatable=True,
    merge=or_,
    metavar="KEY=VALUE",
)
PROPERTIES = Kind[tuple[str, ...]](
    dict[str, Scalar | list[Scalar]] | list[str],
    "a mapping, PROPERTY: VALUE",
    _parse_properties,
    list,
    is_repeatable=True,
    merge=add,
    metavar="KEY=VALUE",
)
