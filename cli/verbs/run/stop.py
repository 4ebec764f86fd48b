"""Stop dataflows."""

import sys
from functools import partial

import click

from dora_systemd.adapters.bus.manager import tell_stage
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    require_names_or_all,
    tell,
)
from dora_systemd.cli.stageline import StageLine
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.selector import selectors_of
from dora_systemd.verbs.stop import not_running, note_stop, stop_cells


@click.command("stop")
@click.argument("selectors", nargs=-1, metavar="SELECTOR...")
@click.option("-a", "--all", "want_all", is_flag=True, help="All dataflows that run.")
@acting_options
def command(selectors: tuple[str, ...], want_all: bool) -> int:
    """Stop dataflows and wait until they have ended.

    Nodes are told to stop; those still running after the grace duration of the dataflow are
    killed. Several dataflows stop at the same time.

    Examples:
      doractl stop robot
      doractl stop 550e8400 vision
      doractl stop 'cam*'
      doractl stop --all
    """
    require_names_or_all("stop", selectors, want_all)
    scope = current_scope()
    bus = Bus(scope)
    cells = read_cells(bus)
    if want_all:
        chosen = [cell for cell in cells if cell.is_up]
        if not chosen:
            tell("No dataflow is running.")
        return _stop(bus, scope, chosen)
    found = {one: one.only(cells) for one in selectors_of(selectors, cells)}
    for one in [one for one, cell in found.items() if cell is None]:
        row = one.ended(scope)
        if row is None:
            raise one.missing(cell.name for cell in cells)
        print_outcomes([not_running(row, row.status.lower())])
    return _stop(bus, scope, list(dict.fromkeys(cell for cell in found.values() if cell)))


def _stop(bus: Bus, scope: Scope, cells: list[Cell]) -> int:
    note_stop(cells)
    with StageLine(sys.stderr) as stage:
        outcomes = stop_cells(bus, scope, cells, partial(tell_stage, stage))
    return print_outcomes(outcomes)
