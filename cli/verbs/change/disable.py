"""No longer start dataflows at boot."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import find_all
from dora_systemd.verbs.releases.listing import refuse_on_trial
from dora_systemd.verbs.start.enable import disable_cell


@click.command("disable")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@acting_options
def command(selectors: tuple[str, ...]) -> int:
    """No longer start dataflows at boot. Running dataflows keep running.

    Removes what enable has created. A dataflow that is not enabled is not an error.

    Examples:
      doractl disable robot
    """
    scope = current_scope()
    bus = Bus(scope)
    chosen = find_all(bus, scope, selectors)
    for cell in chosen:
        refuse_on_trial(scope, cell, "disable")
    return print_outcomes(_disabled(cell, disable_cell(bus, scope, cell)) for cell in chosen)


def _disabled(cell: Cell, is_news: bool) -> Outcome:
    done = "disabled" if is_news else "not enabled"
    return Outcome(cell, f"Dataflow {done}: {cell.uuid} ({cell.name})", is_news=is_news)
