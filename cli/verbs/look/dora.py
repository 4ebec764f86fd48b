"""Run the dora command against one dataflow."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import exec_dora, order_like_dora


@click.command("dora", context_settings={"ignore_unknown_options": True})
@click.argument("selector")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED, metavar="-- ARGUMENT...")
@scope_options
def command(selector: str, arguments: tuple[str, ...]) -> int:
    """Run dora ARGUMENT... against the coordinator of the dataflow SELECTOR.

    Only root and the user that the dataflow runs as may do this. Use doractl logs to read logs:
    dora logs cannot show them.

    Examples:
      doractl dora robot -- topic echo camera/image
      doractl dora robot -- node list
    """
    scope = current_scope()
    bus = Bus(scope)
    cell = Selector(selector).find_present(bus, scope)
    if told := order_like_dora(scope, cell, arguments):
        click.echo(told)
        return 0
    return exec_dora(scope, bus, cell, arguments)
