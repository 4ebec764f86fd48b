"""Inhibit restarts of a dataflow, or list who does."""

import sys

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.listing import print_table
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_json,
    print_outcomes,
    tell,
    wants_json,
)
from dora_systemd.decisions.views.inhibitors import (
    format_inhibited,
    inhibited_objects,
    parse_reason,
)
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import ExitCode, usage_error
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.inhibit import hold, inhibited_dataflows, take_inhibiting


@click.command("inhibit")
@click.argument("selector", required=False)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED, metavar="[-- COMMAND...]")
@click.option("--why", metavar="TEXT", help="The reason, shown to whoever is refused.")
@acting_options
def command(selector: str | None, arguments: tuple[str, ...], why: str | None) -> int:
    """Inhibit restart and reload of a running dataflow while COMMAND runs.

    Without COMMAND, until it is interrupted with Ctrl+C. The lock ends with this process, however
    that ends. Without SELECTOR, list all locks, including those of nodes, which lock the file
    $DORA_INHIBIT_LOCK. The exit status is that of COMMAND.

    Examples:
      doractl inhibit robot --why 'it is driving'
      doractl inhibit robot --why 'mission 12' -- ./mission.sh
      doractl inhibit
    """
    if selector is None:
        return _list(why)
    if why is None:
        hint = f"doractl inhibit {selector} --why TEXT; doractl inhibit lists all locks"
        raise usage_error("cannot inhibit without a reason", hint)
    reason, scope = parse_reason(why), current_scope()
    cell = Selector(selector).find_present(Bus(scope), scope)
    lock = take_inhibiting(scope, cell, reason)
    if not arguments:
        print_outcomes([Outcome(cell, f"Dataflow inhibited: {cell.uuid} ({cell.name})")])
        sys.stdout.flush()
        tell("Ctrl+C ends it.", err=True)
    return hold(lock, arguments)


def _list(why: str | None) -> int:
    if why is not None:
        raise usage_error("cannot inhibit: give a dataflow", "doractl inhibit NAME --why TEXT")
    scope = current_scope()
    found = inhibited_dataflows(Bus(scope, for_reading=True), scope)
    if wants_json():
        print_json(inhibited_objects(found))
    elif found:
        print_table(lambda width, colors: format_inhibited(found, width, colors))
    else:
        click.echo("No dataflow is inhibited.")
    return ExitCode.OK
