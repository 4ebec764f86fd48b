"""Restart or stop a single node."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import (
    acting_options,
    current_scope,
    print_outcomes,
    scope_options,
)
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import restart_node, stop_node


@click.group("node")
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
@acting_options
def restart(selector: str, node: str) -> int:
    """Restart NODE of the dataflow SELECTOR; the other nodes keep running."""
    cell = _cell(selector)
    restart_node(current_scope(), cell, node)
    return print_outcomes([Outcome(cell, f"Node restarting: {node}", node=node)])


@command.command("stop")
@click.argument("selector")
@click.argument("node")
@acting_options
def stop(selector: str, node: str) -> int:
    """Stop NODE of the dataflow SELECTOR for good; its neighbours see their input closed."""
    cell = _cell(selector)
    stop_node(current_scope(), cell, node)
    return print_outcomes([Outcome(cell, f"Node stopping: {node}", node=node)])


def _cell(selector: str) -> Cell:
    return Selector(selector).find(Bus(current_scope()))
