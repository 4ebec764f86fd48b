"""The verbs of doractl as a click group that imports only the verb that runs."""

import re
from collections.abc import Iterable
from contextlib import suppress
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Any, NamedTuple

import click

from dora_systemd import __version__
from dora_systemd.cli.parameters import current_scope, scope_options, without_all
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error

TITLES = {
    "run": "Start and stop",
    "look": "Look",
    "change": "Change what runs",
    "machine": "This machine",
}
_HEADING = "Examples:"
_MOST_MEANT = 3
"""Commands in the hint for an unknown one, if they begin with it."""
SECTIONS = tuple(TITLES)
"""The directories of verbs/, in the order of --help."""


class Verb(NamedTuple):
    """A verb of doractl: the file `path`. Its docstring begins with the line in --help."""

    name: str
    section: str
    path: Path

    @property
    def command(self) -> click.Command:
        name = f"dora_systemd.cli.verbs.{self.section}.{self.name}"
        found: click.Command = import_module(name).command
        _put_examples_last(found)
        found.context_class = _Context
        for member in getattr(found, "commands", {}).values():
            member.epilog, member.context_class = found.epilog, _Context
        return found

    @property
    def summary(self) -> str:
        """The first line of the docstring, read from the file: imports would slow down --help."""
        with self.path.open(encoding="utf-8") as lines:
            return lines.readline().strip().strip('"')


def _put_examples_last(command: click.Command) -> None:
    """Let --help print the examples, with which the docstring ends, below the options."""
    text, mark, examples = cleandoc(command.help or "").partition(f"\n\n{_HEADING}")
    if mark:
        command.help, command.epilog = text, f"\b\n{_HEADING}{examples}"


class _Formatter(click.HelpFormatter):
    """Breaks examples that are wider than the terminal, whose lines click leaves as they are."""

    def write_text(self, text: str) -> None:
        if text.startswith(f"\b\n{_HEADING}"):
            columns = self.width + 2 - self.current_indent  # click leaves two columns empty
            lines = (_fitted_example(line, columns) for line in text.splitlines())
            text = "\n".join(lines)
        super().write_text(text)


class _Context(click.Context):
    formatter_class = _Formatter


def _fitted_example(line: str, columns: int) -> str:
    """Break before options, as a shell reads it; what follows two blanks explains the example."""
    if len(line) <= columns:
        return line
    command, _, text = line.strip().partition("  ")
    lines = [" "]
    for part in re.split(r" (?=[->])", command):
        if lines[-1].strip() and len(f"{lines[-1]} {part} \\") > columns:
            lines[-1] += " \\"
            lines.append("     ")
        lines[-1] += f" {part}"
    return "\n".join([*lines, *([f"      {text.strip()}"] if text else [])])


def find_verbs() -> dict[str, Verb]:
    """Find all verbs by name. A new file is a new verb."""
    root = Path(__file__).with_name("verbs")
    return {
        path.stem: Verb(path.stem, section, path)
        for section in SECTIONS
        for path in sorted(root.joinpath(section).glob("[a-z]*.py"))
    }


VERBS = find_verbs()
HIDDEN = ("member",)
"""Verbs that other machines call, not people."""
SHOWN = {name: verb for name, verb in VERBS.items() if name not in HIDDEN}
"""The others: those in --help, completion and hints."""
ALIASES = {"ps": "list", "status": "list", "reset-failed": "reset"}

SELECTORS = ("selector", "selectors")
"""The names of arguments that mean dataflows."""

WORDS_OF_OTHERS = {
    "ls": "list",
    "stat": "status",
    "inspect": "show",
    "monit": "top",
    "htop": "top",
    "tail": "logs NAME --follow",
    "log": "logs",
    "journal": "logs",
    "kill": "stop",
    "down": "destroy",
    "rm": "stop",
    "delete": "stop",
    "remove": "stop",
    "create": "start",
    "check": "start --dry-run",
    "validate": "start --dry-run",
    "node list": "list NAME",
}
"""Commands of docker, pm2, systemctl and dora, with the equivalent command of doractl."""

_WHOLE = 1000
"""Characters of a summary, which click cuts: more than any has."""

_EPILOG = """\b
Examples:
  doractl start dataflow.yml --name robot
  doractl list
  doractl logs robot --node camera --follow
  doractl why robot
  doractl stop robot
"""


class VerbGroup(click.Group):
    """A group that imports a verb's module only when it runs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(SHOWN)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        del ctx
        verb = VERBS.get(ALIASES.get(cmd_name, cmd_name))
        return verb and verb.command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, *words = args
        args = [name, *without_all(ctx, words)]
        if name.startswith("-") or self.get_command(ctx, name):
            return super().resolve_command(ctx, args)
        hint = _meant_verb(name, [*SHOWN, *ALIASES]) or "doractl --help lists all commands"
        raise usage_error(f"unknown command {name!r}", hint)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs and their summaries without importing them."""
        del ctx
        width = max(map(len, SHOWN))
        for section in SECTIONS:
            rows = [(name, one.summary) for name, one in SHOWN.items() if one.section == section]
            with formatter.section(TITLES[section]):
                formatter.write_dl([(name.ljust(width), summary) for name, summary in rows])


class SubverbGroup(click.Group):
    """A verb with verbs of its own."""

    @property
    def valid(self) -> str:
        return f"valid commands: {', '.join(self.commands)}"

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, group = args[0], self.name or ""
        if name.startswith("-") or name in self.commands:
            return super().resolve_command(ctx, args)
        hint = _meant_verb(name, self.commands, group) or self.valid
        raise usage_error(f"unknown command {f'{group} {name}'!r}", hint)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs with their whole summaries, which click would cut to a line."""
        del ctx
        every = sorted(self.commands.items())
        rows = [(name, one.get_short_help_str(_WHOLE)) for name, one in every]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


@click.group(
    cls=VerbGroup,
    epilog=_EPILOG,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(
    __version__, "-V", "--version", prog_name="doractl", message="%(prog)s %(version)s"
)
@scope_options
@click.pass_context
def doractl(ctx: click.Context) -> None:
    """Run dora dataflows as systemd services.

    SELECTOR below is a name, a UUID, the beginning of a UUID or a unit name; a shell pattern where
    several are possible.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def run_verb(arguments: list[str], group: click.Group = doractl) -> int:
    """Run a command line; its exit status. Raises DoraSystemdError for a wrong one, too."""
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    try:
        result = group.main(arguments, prog_name="doractl", standalone_mode=False)
    except click.ClickException as error:
        raise _usage_error(error, arguments) from error
    except click.Abort as abort:
        if abort.__cause__ is None:  # of a question: click does not end its line
            click.echo(err=True)
        return ExitCode.INTERRUPTED
    except SystemExit as error:
        # Here click exits by itself only if the reader of the output is gone.
        raise BrokenPipeError from error
    return result if isinstance(result, int) else ExitCode.OK


def _meant_verb(name: str, verbs: Iterable[str], group: str = "") -> str:
    """The hint for an unknown verb, or one of a group; "" if no command is similar."""
    from difflib import get_close_matches

    if known := WORDS_OF_OTHERS.get(f"{group} {name}".strip()):
        return f"did you mean doractl {known}?"
    longer = [one for one in verbs if len(name) > 1 and one.startswith(name)]
    near = longer if 0 < len(longer) <= _MOST_MEANT else get_close_matches(name, verbs, n=1)
    meant = " or ".join(" ".join(filter(None, ("doractl", group, one))) for one in near)
    return f"did you mean {meant}?" if meant else ""


def _near(error: click.NoSuchOption) -> list[str]:
    """The options that begin as the unknown one does; else similar ones, which click suggests."""
    from difflib import get_close_matches

    word, options = error.option_name.lstrip("-"), error.possibilities or ()
    params = error.ctx.command.params if error.ctx else []
    every = [one for param in params if not getattr(param, "hidden", False) for one in param.opts]
    longer = [one for one in every if one.startswith(f"--{word}")]
    if len(word) > 1 and longer:
        return longer[:3]
    for least in (0.8, 0.6):
        near = [one for one in options if get_close_matches(one.lstrip("-"), [word], cutoff=least)]
        if near:
            return near
    return []


def _usage_error(error: click.ClickException, arguments: list[str]) -> DoraSystemdError:
    text = error.format_message().rstrip(".")
    context: Any = getattr(error, "ctx", None)
    # An option without its value has none.
    verb = next((one for one in arguments if one in VERBS), "")
    command = context.command_path if context else f"doractl {verb}".strip()
    possible = _near(error) if isinstance(error, click.NoSuchOption) else []
    hint = f"did you mean {' or '.join(sorted(possible))}?" if possible else f"see {command} --help"
    if isinstance(error, click.MissingParameter):
        hint = _known_names(error) or hint
    if context and isinstance(context.command, SubverbGroup) and text == "Missing command":
        hint = context.command.valid
    words = text.split(". Did you mean")[0]
    words = f"{words[:1].lower()}{words[1:]}".replace("no such command", "unknown command", 1)
    if isinstance(error, click.NoSuchOption):
        words = f"unknown option {error.option_name}"
    return usage_error(words, hint)


def _known_names(error: click.MissingParameter) -> str:
    """The hint for a missing SELECTOR: the dataflows that there are."""
    if not error.ctx or not error.param or error.param.name not in SELECTORS:
        return ""
    from dora_systemd.adapters.bus.systemd import Bus
    from dora_systemd.verbs.facts.cells import read_cells

    with suppress(DoraSystemdError):
        names = [cell.name for cell in read_cells(Bus(current_scope(error.ctx), for_reading=True))]
        return f"known dataflows: {', '.join(names)}" if names else ""
    return ""
