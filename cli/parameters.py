"""Options and arguments that several verbs share."""

import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import click

from dora_systemd.cli.edge import Edge, print_error, print_warning, remember_scope
from dora_systemd.decisions.views.outcome import Outcome, outcome_object
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope, scope_of
from dora_systemd.values import parse_duration

C = TypeVar("C", bound=Callable[..., Any] | click.Command)

T = TypeVar("T")

_SCOPE_KEY = "dora_systemd.is_user"
_OUTPUT_KEY = "dora_systemd.output"
_HOST_KEY = "dora_systemd.host"
_HELP_KEY = "dora_systemd.help_all"

HELP_ALL = "--help=all"


def _remember(ctx: click.Context, param: click.Parameter, value: bool | None) -> None:
    del param
    if value is not None:
        ctx.meta[_SCOPE_KEY] = value
        remember_scope(value)


_scope_option = click.option(
    # Its own name, because one of the settings is called "user".
    "--user/--system",
    "wants_user",
    default=None,
    expose_value=False,
    callback=_remember,
    help="Dataflows of the calling user (default unless root), or of the system.",
)


def _refuse_host(ctx: click.Context, param: click.Parameter, value: Sequence[str]) -> None:
    """cli/remote/ takes -H out of a command line: a verb that gets it would act on this machine."""
    if value and not ctx.resilient_parsing:
        raise click.UsageError(f"cannot use {param.opts[0]} here", ctx)
    if value:
        ctx.meta[_HOST_KEY] = True


_host_option = click.option(
    "-H",
    "--host",
    metavar="HOST,...",
    multiple=True,
    expose_value=False,
    callback=_refuse_host,
    help="Do it on these hosts, by ssh: [user@]HOST, or all of the hosts file.",
)


def scope_options(command: C) -> C:
    """`--system`, `--user` and -H, before or after the verb; the last scope counts."""
    return _scope_option(_host_option(command))


def without_all(ctx: click.Context, words: list[str]) -> list[str]:
    """Replace --help=all by --help, for wants_all(). What follows `--` stays."""
    end = words.index("--") if "--" in words else len(words)
    if HELP_ALL not in words[:end]:
        return words
    ctx.meta[_HELP_KEY] = True
    return ["--help" if word == HELP_ALL else word for word in words[:end]] + words[end:]


def wants_all(ctx: click.Context) -> bool:
    """Whether --help shows every option of a verb that has many."""
    return bool(ctx.meta.get(_HELP_KEY))


def is_elsewhere() -> bool:
    """Whether the command line that is being completed has -H."""
    return bool(click.get_current_context().meta.get(_HOST_KEY))


def _output_option(is_exposed: bool) -> Callable[[C], C]:
    return click.option(
        "-o",
        "--output",
        type=click.Choice(["table", "json"]),
        default="table",
        show_default=True,
        expose_value=is_exposed,
        callback=_remember_output,
        help="Table or JSON.",
    )


def _remember_output(ctx: click.Context, param: click.Parameter, value: str) -> str:
    del param
    ctx.meta[_OUTPUT_KEY] = value
    return value


output_option = _output_option(is_exposed=True)
"""Option for verbs that print facts."""


def acting_options(command: C) -> C:
    """Add scope_options, and `-o` for print_outcomes() and `tell()`, to a verb that acts."""
    return _output_option(is_exposed=False)(scope_options(command))


name_option = click.option(
    "--name",
    metavar="NAME",
    help="Name of the dataflow; default: that of its file, or of the directory of a dataflow.yml.",
)
"""Option for verbs that start a dataflow."""


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


def duration_option(flag: str, text: str, default: str = "infinity") -> Callable[[C], C]:
    """An option with a time span in µs. text: for --help. default: without the option."""
    callback = parsed_by(parse_duration)
    return click.option(flag, metavar="TIME", default=default, callback=callback, help=text)


waiting_option = click.option(
    "--allow-waiting",
    is_flag=True,
    help="Let nodes wait for what they need, such as a device that is not plugged in.",
)
"""Option for verbs with a trial of a release."""
serial_option = click.option(
    "--serial",
    type=click.IntRange(min=1),
    metavar="N",
    default=1,
    help="With -H: N hosts at a time, and none after a failed trial; default: 1.",
)
"""Option for verbs that bring a release to hosts."""


def refuse_serial(serial: int) -> None:
    """Raise DoraSystemdError (USAGE) for --serial on a command line without -H."""
    if serial > 1 and not Edge.reached_as:
        hint = "leave it out, or name hosts: -H HOST,..."
        raise usage_error(f"cannot use --serial {serial} without -H", hint)


def current_scope(context: click.Context | None = None) -> Scope:
    """The scope of the command line. context: of an error that has ended it."""
    return scope_of((context or click.get_current_context()).meta.get(_SCOPE_KEY))


def wants_json() -> bool:
    """Whether the command line has `-o json`."""
    context = click.get_current_context(silent=True)
    return context is not None and context.meta.get(_OUTPUT_KEY) == "json"


def print_json(value: Any) -> None:
    """An object or a list of objects as JSON, indented."""
    from dora_systemd.decisions.views.objects import format_json  # imported late: for JSON only

    click.echo(format_json(value, indent=2))


def tell(text: str, err: bool = False) -> None:
    """Print a line, unless the output is JSON."""
    if not wants_json():
        click.echo(text, err=err)


def can_ask() -> bool:
    """Whether a person sees a question, which is written to standard error, and can answer it."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def require_names_or_all(verb: str, selectors: Sequence[str], want_all: bool) -> None:
    """Raise DoraSystemdError (USAGE) unless a command line has either names or --all."""
    if bool(selectors) == want_all:
        hint = f"doractl {verb} NAME, or doractl {verb} --all"
        both = ", not both" if want_all else ""
        raise usage_error(f"cannot {verb}: give names or --all{both}", hint)


def print_outcomes(outcomes: Iterable[Outcome]) -> ExitCode:
    """Print one line or one JSON object for each outcome, at once.

    Returns the exit status of the problem, FAILURE if there are different ones.
    """
    codes = set()
    for one in outcomes:
        _print_outcome(one)
        codes |= {one.code} if one.problem else set()
    return codes.pop() if len(codes) == 1 else ExitCode.FAILURE if codes else ExitCode.OK


def _print_outcome(one: Outcome) -> None:
    if wants_json():
        from dora_systemd.decisions.views.objects import format_json

        _, _, action = click.get_current_context().command_path.partition(" ")
        click.echo(format_json(outcome_object(one, action)))
    elif one.error:
        print_error(one.error, is_json=False)
    else:
        click.echo(one.text)


def print_warnings(warnings: Iterable[str]) -> None:
    """Print one line or one JSON object for each warning that is not "", on standard error."""
    for warning in filter(None, warnings):
        print_warning(warning, wants_json())
