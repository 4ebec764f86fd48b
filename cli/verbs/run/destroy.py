"""Stop all dataflows and the gateway."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, print_outcomes, scope_options
from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.destroy import (
    processes_left,
    running_cells,
    stop_all,
    stop_gateway,
    stop_slice,
)
from dora_systemd.verbs.facts.enabled import enabled_names
from dora_systemd.verbs.gateway import read_gateway
from dora_systemd.verbs.stop import note_stop


@click.command("destroy")
@click.option("--force", is_flag=True, help="Kill the nodes, instead of telling them to stop.")
@scope_options
def command(force: bool) -> int:
    """Stop all dataflows, the gateway and dora.slice, and check that no process is left.

    Only this scope is affected: the system's, or the calling user's. Enabled dataflows
    stay enabled.

    Examples:
      doractl destroy
      doractl --user destroy --force
    """
    scope = current_scope()
    bus = Bus(scope)
    is_good = _stop_dataflows(bus, scope, force)
    was_up = read_gateway(bus).is_up
    if was_up:
        click.echo("Shutting down daemon...")
    stop_gateway(bus, scope)
    others = stop_slice(bus)
    if was_up:
        click.echo("  ✓ Daemon stopped")
    return ExitCode.OK if _print_left(bus, scope, others) and is_good else ExitCode.FAILURE


def _stop_dataflows(bus: Bus, scope: Scope, force: bool) -> bool:
    """Print the results; whether all dataflows have stopped."""
    cells = running_cells(bus)
    if not cells:
        click.echo("No dataflow is running.")
        return True
    note_stop(cells, "doractl destroy")
    click.echo("Stopping all dataflows...")
    return print_outcomes(stop_all(bus, scope, force)) is ExitCode.OK


def _print_left(bus: Bus, scope: Scope, others: list[str]) -> bool:
    """Print what is left; whether nothing of ours is."""
    if others:
        click.echo(f"Not touched in dora.slice, not managed by doractl: {', '.join(others)}")
    left = processes_left(bus, others)
    for one in left:
        click.echo(f"doractl: cannot end {one}", err=True)
    if not left:
        click.echo("Nothing is left: no process in dora.slice.")
    if names := enabled_names(bus, scope):
        click.echo(f"Still enabled: {', '.join(names)}; they start at the next boot.")
    return not left
