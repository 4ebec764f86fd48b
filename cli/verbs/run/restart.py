"""Restart dataflows."""

import sys
from collections.abc import Mapping
from typing import Any

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, print_outcomes, scope_options
from dora_systemd.cli.stageline import StageLine
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.stop import restart_cells


@click.command("restart")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@scope_options
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
    chosen = dict.fromkeys(Selector(one).find_enabled(bus, scope) for one in selectors)
    with StageLine(sys.stderr) as stage:
        outcomes = restart_cells(bus, list(chosen), lambda changes: _show(stage, changes))
    return print_outcomes(outcomes)


def _show(stage: StageLine, changes: Mapping[str, Any]) -> None:
    if changes.get("StatusText"):
        stage(changes["StatusText"])
