"""Clear failures and reset restart counters."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    require_names_or_all,
    tell,
)
from dora_systemd.verbs.facts.cells import proven, read_cells
from dora_systemd.verbs.facts.selector import selectors_of
from dora_systemd.verbs.stop import reset_cells


@click.command("reset")
@click.argument("selectors", nargs=-1, metavar="SELECTOR...")
@click.option("-a", "--all", "want_all", is_flag=True, help="All dataflows that systemd knows.")
@acting_options
def command(selectors: tuple[str, ...], want_all: bool) -> int:
    """Clear the failure of dataflows and reset their restart counters.

    Like systemctl reset-failed: running dataflows keep running, and systemd may restart them as
    often as at the beginning. dora counts restarts of single nodes; doractl restart resets those.

    Examples:
      doractl reset robot
      doractl reset --all
    """
    require_names_or_all("reset", selectors, want_all)
    scope = current_scope()
    bus = Bus(scope)
    cells = read_cells(bus)
    chosen = proven(cells) if want_all else []
    for one in selectors_of(selectors, cells):
        with one.telling_ended(scope):
            chosen.append(one.loaded(cells))
    if want_all and not chosen:
        tell("No dataflow.")
    return print_outcomes(reset_cells(bus, scope, list(dict.fromkeys(chosen))))
