"""List releases, and which of them runs."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.decisions.views.objects import switch_object
from dora_systemd.decisions.views.releases import format_history, format_releases, release_object
from dora_systemd.errors import usage_error
from dora_systemd.scope import Scope
from dora_systemd.verbs.releases.listing import deployed_names, read_history, read_releases
from dora_systemd.verbs.releases.rollback import deployed_name


@click.command("releases")
@click.argument("selector", required=False)
@click.option("--history", "want_history", is_flag=True, help="What ran when, and why it ended.")
@output_option
@scope_options
def command(selector: str | None, want_history: bool, output: str) -> None:
    """List the releases of all dataflows, or of one, newest first.

    current: what every start and boot runs. trial: it runs, and has not proved itself yet. proved:
    it has passed its trial. failed: it has not, for the reason in WHY. rolled-back: somebody has
    gone back from it. unproved: its trial did not end. Of failed, rolled-back and unproved ones
    rollback chooses none by itself.

    Examples:
      doractl releases
      doractl releases robot --history
      doractl releases robot -o json
    """
    scope = current_scope()
    bus = Bus(scope, for_reading=True)
    if want_history:
        _print_history(bus, scope, selector, output)
        return
    names = deployed_names(scope) if selector is None else [deployed_name(bus, scope, selector)]
    rows = read_releases(bus, scope, names)
    if output == "json":
        print_json(list(map(release_object, rows)))
    elif rows:
        print_table(lambda width, colors: format_releases(rows, width, colors))
    else:
        click.echo("No release.")


def _print_history(bus: Bus, scope: Scope, selector: str | None, output: str) -> None:
    if selector is None:
        hint = "doractl releases NAME --history"
        raise usage_error("--history needs the name of a dataflow", hint)
    name = deployed_name(bus, scope, selector)
    history = read_history(bus, scope, name)
    if output == "json":
        print_json([switch_object(name, one) for one in history])
    elif history:
        print_table(lambda width, colors: format_history(history, width, colors))
    else:
        click.echo("No release has run.")
