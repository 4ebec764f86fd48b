"""Restart or stop a single node."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.group import SubverbGroup
from dora_systemd.cli.inhibit_options import TellWaiting, if_inhibited, inhibit_options
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes, scope_options
from dora_systemd.decisions.cell.status import RESTART, STOP
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.containers import outside_of_node, with_left
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import NodeOrder, order_node

_DOORS = {RESTART: "doractl node restart", STOP: "doractl node stop"}
"""The command that the journal records as requester."""


@click.group("node", cls=SubverbGroup, no_args_is_help=False)
@scope_options
def command() -> None:
    """Restart or stop a single node of a running dataflow.

    Examples:
      doractl node restart robot camera
      doractl node stop robot plot
    """


@command.command("restart")
@click.argument("selector")
@click.argument("node")
@inhibit_options
@acting_options
def restart(selector: str, node: str, force: bool, wait: bool) -> int:
    """Restart NODE of the dataflow SELECTOR; it uses up none of its automatic restarts."""
    return _order(selector, RESTART, node, if_inhibited(force, wait))


@command.command("stop")
@click.argument("selector")
@click.argument("node")
@inhibit_options
@acting_options
def stop(selector: str, node: str, force: bool, wait: bool) -> int:
    """Stop NODE of the dataflow SELECTOR until it is restarted; the other nodes keep running."""
    return _order(selector, STOP, node, if_inhibited(force, wait))


def _order(selector: str, what: str, node: str, how: IfInhibited) -> int:
    scope = current_scope()
    bus = Bus(scope)
    cell = Selector(selector).find_present(bus, scope)
    given = NodeOrder(what, node, _DOORS[what])
    outside = outside_of_node(bus, cell.unit, node)
    done = order_node(scope, cell, given, how=how, tell=TellWaiting())
    return print_outcomes(with_left([Outcome(cell, done, node=node)], outside))
