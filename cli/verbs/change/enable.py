"""Start dataflows at every boot."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, print_warnings, scope_options
from dora_systemd.verbs.facts.selector import find_all
from dora_systemd.verbs.start.enable import enable_cell
from dora_systemd.verbs.start.linger import ensure_linger


@click.command("enable")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@scope_options
def command(selectors: tuple[str, ...]) -> None:
    """Start dataflows at every boot, as they run now.

    UUID and settings stay, and running dataflows keep running. The unit becomes a file that
    systemctl edits, shows and disables like any other.

    Examples:
      doractl enable robot
      doractl enable robot vision
    """
    scope = current_scope()
    bus = Bus(scope)
    for cell in find_all(bus, scope, selectors):
        boot, is_news = enable_cell(bus, scope, cell)
        already = "" if is_news else " already"
        click.echo(f"Dataflow{already} enabled: {cell.uuid} ({cell.name})")
        click.echo(f"Unit file: {boot.path}")
    print_warnings([ensure_linger(scope)])
