"""The verbs of doractl as a click group that imports a verb's module only when it is called."""

from importlib import import_module
from typing import Any, NamedTuple

import click

from dora_systemd import __version__
from dora_systemd.cli.parameters import scope_options
from dora_systemd.errors import DoraSystemdError, ExitCode


class Verb(NamedTuple):
    """Where a verb is (`command` in that module of dora_systemd.cli) and its line in --help."""

    module: str
    summary: str


VERBS = {
    "start": Verb("start", "Start a dataflow as a systemd service."),
    "run": Verb("run", "Run a dataflow in the foreground."),
    "list": Verb("list", "List dataflows, or the nodes of one."),
    "top": Verb("top", "Show live resource usage of dataflows and nodes."),
    "logs": Verb("logs", "Print what the nodes of a dataflow wrote."),
    "why": Verb("why", "Explain what happened to a dataflow and why."),
    "stop": Verb("stop", "Stop dataflows."),
    "restart": Verb("restart", "Restart dataflows."),
    "reset": Verb("reset", "Clear failures and reset restart counters."),
    "node": Verb("node", "Restart or stop a single node."),
    "reload": Verb("reload", "Apply changed files, restarting only the affected nodes."),
    "set": Verb("set", "Change limits or hot reload of a running dataflow."),
    "enable": Verb("enable", "Start dataflows at every boot."),
    "disable": Verb("disable", "No longer start dataflows at boot."),
    "show": Verb("show", "Print the unit of a dataflow."),
    "export": Verb("export", "Print a unit file that works without doractl."),
    "dora": Verb("dora", "Run the dora command against one dataflow."),
    "up": Verb("up", "Open one port for all dataflows."),
    "env": Verb("env", "Print variables that point the stock dora command at the gateway."),
    "destroy": Verb("destroy", "Stop all dataflows and the gateway."),
    "doctor": Verb("doctor", "Check this machine for problems."),
    "setup": Verb("setup", "Install units, completions and manuals after pip install."),
    "version": Verb("version", "Print the versions of doractl, Python, systemd and dora."),
}
ALIASES = {"ps": "list", "status": "list"}

_EPILOG = """\b
Examples:
  doractl start dataflow.yml --name robot
  doractl list
  doractl logs robot --node camera --follow
  doractl why robot
  doractl stop robot
"""


class VerbGroup(click.Group):
    """A group that imports a verb's module only when that verb is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        del ctx
        verb = VERBS.get(ALIASES.get(cmd_name, cmd_name))
        if verb is None:
            return None
        command: click.Command = import_module(f"dora_systemd.cli.{verb.module}").command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name.startswith("-") or self.get_command(ctx, name):
            return super().resolve_command(ctx, args)
        from difflib import get_close_matches

        near = get_close_matches(name, [*VERBS, *ALIASES], n=1)
        hint = f"did you mean doractl {near[0]}?" if near else "doractl --help lists all commands"
        raise DoraSystemdError(f"unknown command {name!r}", hint, ExitCode.USAGE)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The verbs with their lines of the table: --help imports none of them."""
        del ctx
        with formatter.section("Verbs"):
            formatter.write_dl([(name, verb.summary) for name, verb in VERBS.items()])


@click.group(
    cls=VerbGroup,
    epilog=_EPILOG,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="doractl", message="%(prog)s %(version)s")
@scope_options
@click.pass_context
def doractl(ctx: click.Context) -> None:
    """Run dora dataflows as systemd services.

    SELECTOR below is a name, a UUID, the beginning of a UUID or a unit name.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def run_verb(arguments: list[str]) -> int:
    """Run a command line and return its exit status; DoraSystemdError for a wrong one, too."""
    try:
        result = doractl.main(arguments, prog_name="doractl", standalone_mode=False)
    except click.ClickException as error:
        raise _usage_error(error) from error
    except click.Abort:
        return ExitCode.INTERRUPTED
    except SystemExit as error:
        # The only one of click's own here: nobody reads our output any more.
        raise BrokenPipeError from error
    return result if isinstance(result, int) else ExitCode.OK


def _usage_error(error: click.ClickException) -> DoraSystemdError:
    """One of click's own errors in the words of all others."""
    text = error.format_message().rstrip(".")
    context: Any = getattr(error, "ctx", None)
    command = context.command_path if context else "doractl"
    possible = getattr(error, "possibilities", None)
    hint = f"did you mean {' or '.join(sorted(possible))}?" if possible else f"see {command} --help"
    words = text.split(". Did you mean")[0]
    words = f"{words[:1].lower()}{words[1:]}".replace("no such command", "unknown command", 1)
    if isinstance(error, click.NoSuchOption):
        words = f"unknown option {error.option_name}"
    return DoraSystemdError(words, hint, ExitCode.USAGE)
