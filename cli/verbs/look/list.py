"""List dataflows, or the nodes of one."""

import click

from dora_systemd.cli.listing import ListRequest, print_dataflows
from dora_systemd.cli.parameters import current_scope, output_option, scope_options


@click.command("list")
@click.argument("selector", required=False)
@click.option("-a", "--all", "want_all", is_flag=True, help="Include failed and ended dataflows.")
@output_option
@scope_options
def command(selector: str | None, want_all: bool, output: str) -> int:
    """List dataflows; with a SELECTOR, one dataflow and its nodes.

    CPU% is the percentage of one processor. With a SELECTOR the exit status is 3 unless that
    dataflow is running, as with systemctl status.

    Examples:
      doractl list                all that run
      doractl list --all          also those that failed or ended
      doractl list robot          the nodes of one
      doractl list -o json
    """
    return print_dataflows(ListRequest(selector, want_all, output, current_scope().is_user))
