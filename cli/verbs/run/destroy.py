"""Stop all dataflows and the gateway."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.inhibit_options import TellWaiting, if_inhibited
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes, tell
from dora_systemd.decisions.views.outcome import Outcome, Thing
from dora_systemd.errors import ExitCode
from dora_systemd.names import SLICE
from dora_systemd.scope import Scope
from dora_systemd.verbs.destroy import (
    drop_all_disabled,
    processes_left,
    running_cells,
    stop_all,
    stop_gateway,
    stop_slice,
)
from dora_systemd.verbs.facts.enabled import enabled_names
from dora_systemd.verbs.facts.locks import uninhibited
from dora_systemd.verbs.gateway import read_gateway
from dora_systemd.verbs.stop import note_stop


@click.command("destroy")
@click.option("--force", is_flag=True, help="Kill the nodes at once, even if a lock inhibits it.")
@click.option("--wait", is_flag=True, help="Wait while a lock inhibits it.")
@acting_options
def command(force: bool, wait: bool) -> int:
    """Stop all dataflows, the gateway and dora.slice, and check that no process is left.

    Only this scope is affected: the system's, or the calling user's. Enabled dataflows
    stay enabled. Refused while doractl inhibit or a node inhibits one of them.

    Examples:
      doractl destroy
      doractl --user destroy --force
    """
    scope = current_scope()
    bus = Bus(scope)
    with uninhibited(scope, running_cells(bus), "stop", if_inhibited(force, wait), TellWaiting()):
        is_good = _stop_dataflows(bus, scope, force)
    drop_all_disabled(bus, scope)
    was_up = read_gateway(bus).is_up
    if was_up:
        tell("Shutting down daemon...")
    stop_gateway(bus, scope)
    others = stop_slice(bus)
    if was_up:
        tell("  ✓ Daemon stopped")
    return ExitCode.OK if _print_left(bus, scope, others) and is_good else ExitCode.FAILURE


def _stop_dataflows(bus: Bus, scope: Scope, force: bool) -> bool:
    """Print the results; whether all dataflows have stopped."""
    cells = running_cells(bus)
    if not cells:
        tell("No dataflow is running.")
        return True
    note_stop(cells, "doractl destroy")
    tell("Stopping all dataflows...")
    return print_outcomes(stop_all(bus, scope, force)) is ExitCode.OK


def _print_left(bus: Bus, scope: Scope, others: list[str]) -> bool:
    if others:
        tell(f"Not touched in dora.slice, not managed by doractl: {', '.join(others)}")
    names = enabled_names(bus, scope)
    details = {"other_units": others, "enabled": names}
    left = [("", f"cannot end {one}") for one in processes_left(bus, others)]
    texts = left or [("Nothing is left: no process in dora.slice.", "")]
    status = print_outcomes(Outcome(Thing(SLICE), *one, details=details) for one in texts)
    if names:
        tell(f"Still enabled: {', '.join(names)}; they start at the next boot.")
    return status is ExitCode.OK
