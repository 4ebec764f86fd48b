"""Restart dataflows."""

import sys
from functools import partial

import click

from dora_systemd.adapters.bus.manager import tell_stage
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes
from dora_systemd.cli.stageline import StageLine
from dora_systemd.verbs.facts.selector import find_all
from dora_systemd.verbs.stop import restart_cells


@click.command("restart")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@acting_options
def command(selectors: tuple[str, ...]) -> int:
    """Restart dataflows and wait until all their nodes are ready again.

    Name, UUID and settings stay; the dataflow file is read again. A failed dataflow is started
    again.

    Examples:
      doractl restart robot
      doractl restart robot vision
    """
    scope = current_scope()
    bus = Bus(scope)
    chosen = find_all(bus, scope, selectors)
    with StageLine(sys.stderr) as stage:
        outcomes = restart_cells(bus, chosen, partial(tell_stage, stage))
    return print_outcomes(outcomes)
