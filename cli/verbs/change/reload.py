"""Apply changed files, restarting only the affected nodes."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.reload import reload_cell


@click.command("reload")
@click.argument("selector")
@click.option("--node", metavar="NODE", help="Reload this node, whether it has changed or not.")
@acting_options
def command(selector: str, node: str | None) -> int:
    """Apply files that have changed since a running dataflow read them.

    Like hot reload when a file is saved: only the affected nodes restart, and a change that cannot
    be used has no effect. See HOT RELOAD in dora-systemd(7).

    Examples:
      doractl reload robot
      doractl reload robot --node detector
    """
    scope = current_scope()
    cell = Selector(selector).find(Bus(scope))
    done = [f"{line[:1].upper()}{line[1:]}" for line in reload_cell(scope, cell, node)]
    text = "\n".join(done) or "Nothing has changed"
    outcome = Outcome(cell, text, is_news=bool(done), node=node or "", details={"changes": done})
    return print_outcomes([outcome])
