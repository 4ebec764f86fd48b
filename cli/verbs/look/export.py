"""Print a unit file that works without doractl."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.show import export_cell


@click.command("export")
@click.argument("selector")
@scope_options
def command(selector: str) -> None:
    """Print the unit of a dataflow as one unit file, including its drop-ins.

    Copy it to a unit directory and run systemctl enable. Of dora-systemd it needs only the runner.
    Environment variables are printed with their values.

    Examples:
      doractl export robot
      doractl export robot > /etc/systemd/system/dora-robot.service
    """
    scope = current_scope()
    bus = Bus(scope, for_reading=True)
    write_exactly(export_cell(bus, scope, Selector(selector).find_present(bus, scope)))
