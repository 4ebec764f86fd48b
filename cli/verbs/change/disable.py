"""No longer start dataflows at boot."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.verbs.facts.selector import find_all
from dora_systemd.verbs.start.enable import disable_cell


@click.command("disable")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@scope_options
def command(selectors: tuple[str, ...]) -> None:
    """No longer start dataflows at boot. Running dataflows keep running.

    Removes what enable has created. A dataflow that is not enabled is not an error.

    Examples:
      doractl disable robot
    """
    scope = current_scope()
    bus = Bus(scope)
    for cell in find_all(bus, scope, selectors):
        done = disable_cell(bus, scope, cell)
        click.echo(f"Dataflow {'disabled' if done else 'not enabled'}: {cell.uuid} ({cell.name})")
