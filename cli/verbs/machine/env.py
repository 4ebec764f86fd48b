"""Print variables that point the stock dora command at the gateway."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.decisions.dora.command import SHELLS, format_exports, format_unsets
from dora_systemd.errors import usage_error
from dora_systemd.verbs.gateway import read_variables


@click.command("env")
@click.argument("selector", required=False)
@click.option(
    "--shell",
    type=click.Choice(list(SHELLS)),
    default="sh",
    show_default=True,
    help="Shell to print for; sh also works for bash and zsh.",
)
@click.option(
    "--unset", "want_unset", is_flag=True, help="Print commands that unset these variables."
)
@scope_options
def command(selector: str | None, shell: str, want_unset: bool) -> None:
    """Print the variables with which the stock dora command finds the gateway.

    With SELECTOR: the coordinator of that dataflow only, unless its network is private. The output
    contains a token that is as good as a password; it is meant for eval.

    Examples:
      eval "$(doractl env)"; dora list
      eval "$(doractl env robot)"; dora node list
      doractl env --shell fish | source
      eval "$(doractl env --unset)"
    """
    if want_unset and selector is not None:
        hint = "leave SELECTOR out: --unset is for all variables"
        raise usage_error("cannot unset for one dataflow", hint)
    if want_unset:
        click.echo(format_unsets(shell))
        return
    scope = current_scope()
    variables = read_variables(Bus(scope, for_reading=True), scope, selector)
    write_exactly(f"{format_exports(shell, variables)}\n")
