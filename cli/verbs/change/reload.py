"""Apply changed files, restarting only the affected nodes."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.inhibit_options import TellWaiting, if_inhibited, inhibit_options
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    print_warnings,
)
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.locks import require_uninhibited
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.reload import reload_cell
from dora_systemd.verbs.start.programs import version_warnings


@click.command("reload")
@click.argument("selector")
@click.option("--node", metavar="NODE", help="Reload this node, whether it has changed or not.")
@inhibit_options
@acting_options
def command(selector: str, node: str | None, force: bool, wait: bool) -> int:
    """Apply files that have changed since a running dataflow read them.

    Like hot reload when a file is saved: only the affected nodes restart, and a change that cannot
    be used has no effect. Refused while doractl inhibit or a node inhibits it. See HOT RELOAD in
    dora-systemd-nodes(7).

    Examples:
      doractl reload robot
      doractl reload robot --node detector
    """
    how = if_inhibited(force, wait)
    scope = current_scope()
    bus = Bus(scope)
    cell = Selector(selector).find_present(bus, scope)
    require_uninhibited(scope, [cell], "reload", how, TellWaiting())
    done = [f"{line[:1].upper()}{line[1:]}" for line in reload_cell(scope, cell, node)]
    print_warnings(version_warnings(bus, [cell]))
    text = "\n".join(done) or "Nothing has changed"
    outcome = Outcome(cell, text, is_news=bool(done), node=node or "", details={"changes": done})
    return print_outcomes([outcome])
