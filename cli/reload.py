"""doractl reload: have a running dataflow take over what has changed."""

import click

from dora_systemd.bus import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.managercells import read_cells, select_cell
from dora_systemd.managerreload import reload_cell

_EPILOG = """\b
Examples:
  doractl reload robot
  doractl reload robot --node detector
"""


@click.command("reload", epilog=_EPILOG)
@click.argument("selector")
@click.option("--node", metavar="NODE", help="Reload this node, changed or not.")
@scope_options
def command(selector: str, node: str | None) -> None:
    """Have a running dataflow take over files that have changed since it read them.

    As hot reload does it when a file is saved: only the nodes that a change concerns start again,
    and what cannot be used changes nothing. See HOT RELOAD in dora-systemd(7).
    """
    scope = current_scope()
    cell = select_cell(read_cells(Bus(scope)), selector)
    done = reload_cell(scope, cell, node)
    click.echo("\n".join(f"{line[:1].upper()}{line[1:]}" for line in done) or "Nothing has changed")
