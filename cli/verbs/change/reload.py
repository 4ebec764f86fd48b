"""Apply changed files, restarting only the affected nodes."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.reload import reload_cell


@click.command("reload")
@click.argument("selector")
@click.option("--node", metavar="NODE", help="Reload this node, whether it has changed or not.")
@scope_options
def command(selector: str, node: str | None) -> None:
    """Apply files that have changed since a running dataflow read them.

    Like hot reload when a file is saved: only the affected nodes restart, and a change that cannot
    be used has no effect. See HOT RELOAD in dora-systemd(7).

    Examples:
      doractl reload robot
      doractl reload robot --node detector
    """
    scope = current_scope()
    done = reload_cell(scope, Selector(selector).find(Bus(scope)), node)
    click.echo("\n".join(f"{line[:1].upper()}{line[1:]}" for line in done) or "Nothing has changed")
