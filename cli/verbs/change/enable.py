"""Start dataflows at every boot."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    print_warnings,
)
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import find_all
from dora_systemd.verbs.releases.listing import refuse_on_trial
from dora_systemd.verbs.start.enable import BootUnit, enable_cell
from dora_systemd.verbs.start.logins import ensure_linger


@click.command("enable")
@click.argument("selectors", nargs=-1, required=True, metavar="SELECTOR...")
@click.option(
    "--boot-check",
    is_flag=True,
    help="A boot is good only if they come up (boot-complete.target).",
)
@acting_options
def command(selectors: tuple[str, ...], boot_check: bool) -> int:
    """Start dataflows at every boot, as they run now.

    UUID and settings stay, and running dataflows keep running. The unit becomes a file that
    systemctl edits, shows and disables like any other.

    Examples:
      doractl enable robot
      doractl enable robot vision
      doractl enable robot --boot-check
    """
    scope = current_scope()
    bus = Bus(scope)
    chosen = find_all(bus, scope, selectors)
    for cell in chosen:
        refuse_on_trial(scope, cell, "enable")
    status = print_outcomes(
        _enabled(cell, *enable_cell(bus, scope, cell, boot_check)) for cell in chosen
    )
    print_warnings([ensure_linger(scope)])
    return status


def _enabled(cell: Cell, boot: BootUnit, is_news: bool) -> Outcome:
    already = "" if is_news else " already"
    text = f"Dataflow{already} enabled: {cell.uuid} ({cell.name})\nUnit file: {boot.path}"
    return Outcome(cell, text, is_news=is_news, details={"unit_file": str(boot.path)})
