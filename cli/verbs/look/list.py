"""List dataflows, or the nodes of one."""

from typing import Any

import click

from dora_systemd.cli.listing import ListRequest, print_dataflows
from dora_systemd.cli.parameters import current_scope, output_option, scope_options
from dora_systemd.decisions.views.selection import SORTS, STATUSES


@click.command("list")
@click.argument("selector", required=False)
@click.option(
    "-a",
    "--all",
    "want_all",
    is_flag=True,
    help="Include what failed or ended, a row for each name.",
)
@click.option(
    "--last",
    type=click.IntRange(min=1),
    metavar="N",
    help="Include what failed or ended, only the N newest.",
)
@click.option(
    "--status",
    type=click.Choice(list(STATUSES), case_sensitive=False),
    metavar="STATUS",
    help=f"Only dataflows with this status: {', '.join(STATUSES)}.",
)
@click.option("--name", "pattern", metavar="PATTERN", help="Only dataflows with this in the name.")
@click.option(
    "--sort-by",
    type=click.Choice(SORTS),
    metavar="COLUMN",
    help=f"Sort by {', '.join(SORTS)}; highest first.",
)
@click.option(
    "-q",
    "--quiet",
    "is_quiet",
    is_flag=True,
    help="Print UUIDs only, one a line; without --all of what runs.",
)
@output_option
@scope_options
def command(**options: Any) -> int:
    """List dataflows; with a SELECTOR, one dataflow and its nodes; with a pattern, all that match.

    CPU% is the percentage of one processor; limits follow a slash. RESTARTS counts restarts of the
    whole dataflow by systemd; for a node, those of this node by dora. With a SELECTOR the exit
    status is 3 unless that dataflow is running, as with systemctl status.

    Examples:
      doractl list                      what failed, and all that run
      doractl list --last 5             also the five that ended last, and why
      doractl list robot                the nodes of one
      doractl list 'cam*' --all         whose name begins so, also what has ended
      doractl list --status failed -q   UUIDs of all that failed
      doractl list -o json
    """
    return print_dataflows(ListRequest(is_user=current_scope().is_user, **options))
