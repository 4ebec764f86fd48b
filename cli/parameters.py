"""Options and arguments that several verbs share."""

import json
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import click

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope, scope_of

if TYPE_CHECKING:
    # Imported late: only some verbs print outcomes.
    from dora_systemd.verbs.stop import Outcome

T = TypeVar("T")

_SCOPE_KEY = "dora_systemd.is_user"


def _remember(ctx: click.Context, param: click.Parameter, value: bool | None) -> None:
    del param
    if value is not None:
        ctx.meta[_SCOPE_KEY] = value


scope_options = click.option(
    # Its own name, because one of the settings is called "user".
    "--user/--system",
    "wants_user",
    default=None,
    expose_value=False,
    callback=_remember,
    help="Dataflows of the calling user (default unless root), or of the system.",
)
"""`--system` and `--user`, before or after the verb; the last one counts."""

output_option = click.option(
    "-o",
    "--output",
    type=click.Choice(["table", "json"]),
    default="table",
    show_default=True,
    help="Table or JSON.",
)

name_option = click.option(
    "--name",
    metavar="NAME",
    help="Name of the dataflow; default: that of its file, or of the directory of a dataflow.yml.",
)
"""For what starts a dataflow."""


def parsed_by(parse: Callable[[str], T]) -> Callable[[click.Context, click.Parameter, str], T]:
    """The callback of an option whose text `parse` reads; its errors (USAGE) name the option."""

    def parsed(ctx: click.Context, param: click.Parameter, text: str) -> T:
        del ctx
        try:
            return parse(text)
        except DoraSystemdError as error:
            message = f"{error.message} ({param.opts[-1]})"
            raise DoraSystemdError(message, error.hint, error.code) from error

    return parsed


def current_scope() -> Scope:
    """The scope of the command line."""
    return scope_of(click.get_current_context().meta.get(_SCOPE_KEY))


def print_json(value: Any) -> None:
    """`value` as JSON, indented."""
    click.echo(json.dumps(value, indent=2))


def require_names_or_all(verb: str, selectors: Sequence[str], want_all: bool) -> None:
    """Raise DoraSystemdError (USAGE) unless a command line has either names or --all."""
    if bool(selectors) == want_all:
        hint = f"doractl {verb} NAME, or doractl {verb} --all"
        raise DoraSystemdError(f"cannot {verb}: give names or --all", hint, ExitCode.USAGE)


def print_outcomes(outcomes: "Iterable[Outcome]") -> ExitCode:
    """One line for each dataflow, at once; FAILURE if any has a problem."""
    status = ExitCode.OK
    for one in outcomes:
        if one.problem:
            click.echo(f"doractl: {one.problem}", err=True)
            status = ExitCode.FAILURE
        else:
            click.echo(one.text)
    return status


def print_warnings(warnings: Iterable[str]) -> None:
    """One line each, on standard error, without empty ones."""
    for warning in filter(None, warnings):
        click.echo(f"doractl: {warning}", err=True)
