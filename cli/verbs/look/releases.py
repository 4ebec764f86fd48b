"""List releases, and which of them runs."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.views.releases import format_releases, release_object
from dora_systemd.verbs.releases.listing import deployed_names, read_releases
from dora_systemd.verbs.releases.rollback import deployed_name


@click.command("releases")
@click.argument("selector", required=False)
@output_option
@scope_options
def command(selector: str | None, output: str) -> None:
    """List the releases of all dataflows, or of one, newest first.

    current: what every start and boot runs. trial: it runs, and has not proved itself yet. proved:
    it has passed its trial. unproved: it has not.

    Examples:
      doractl releases
      doractl releases robot -o json
    """
    scope = current_scope()
    bus = Bus(scope, for_reading=True)
    names = deployed_names(scope) if selector is None else [deployed_name(bus, scope, selector)]
    rows = read_releases(bus, scope, names)
    if output == "json":
        print_json(list(map(release_object, rows)))
    elif rows:
        print_table(lambda width, colors: format_releases(rows, width, colors))
    else:
        click.echo("No release.")
