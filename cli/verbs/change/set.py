"""Change limits or hot reload of a running dataflow."""

from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, print_warnings, scope_options
from dora_systemd.cli.settingoptions import live_options
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import require_running
from dora_systemd.verbs.reload import switch_hot_reload
from dora_systemd.verbs.set import set_limits


@click.command("set")
@click.argument("selector")
@live_options
@click.option("--hot-reload", type=click.Choice(["on", "off"]), help="Turn hot reload on or off.")
@click.option("--force", is_flag=True, help="Set a memory limit below the current usage, too.")
@scope_options
def command(selector: str, hot_reload: str | None, force: bool, **flags: Any) -> None:
    """Change limits or hot reload of a running dataflow.

    Changes take effect at once and survive restarts, until the dataflow is stopped; those of an
    enabled dataflow, until it is disabled. If it does not run, its next start has them. infinity
    removes a limit. If one change is invalid, nothing is changed.

    Examples:
      doractl set robot --memory-limit 6G
      doractl set robot --node-limit detector:memory=2G,cpu=1.5
      doractl set robot --cpu-limit infinity
      doractl set robot --hot-reload on
    """
    scope = current_scope()
    bus = Bus(scope)
    cell = Selector(selector).find(bus)
    if hot_reload is not None:
        require_running(cell)
    if hot_reload is None or any(value not in (None, ()) for value in flags.values()):
        print_warnings(set_limits(bus, scope, cell, flags, force))
        when = "" if cell.is_up else " for the next start"
        click.echo(f"Limits changed{when}: {cell.uuid} ({cell.name})")
    if hot_reload is not None:
        switch_hot_reload(bus, scope, cell, hot_reload == "on")
        click.echo(f"Hot reload {hot_reload}: {cell.uuid} ({cell.name})")
