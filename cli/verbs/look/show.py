"""Print the unit of a dataflow."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import write_exactly
from dora_systemd.cli.parameters import current_scope, output_option, print_json, scope_options
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.show import format_unit_files, unit_files


@click.command("show")
@click.argument("selector")
@output_option
@scope_options
def command(selector: str, output: str) -> None:
    """Print the unit of a dataflow, each file below a comment with its path.

    Environment variables are printed with their values.

    Examples:
      doractl show robot
      doractl show robot -o json
    """
    scope = current_scope()
    bus = Bus(scope, for_reading=True)
    cell = Selector(selector).find_present(bus, scope)
    files = unit_files(bus, cell)
    if output == "json":
        print_json({"name": cell.name, "uuid": cell.uuid, "unit": cell.unit, "files": files})
    else:
        write_exactly(format_unit_files(files))
