"""Restart or stop a single node."""

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
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
@scope_options
def restart(selector: str, node: str) -> None:
    """Restart NODE of the dataflow SELECTOR; the other nodes keep running."""
    restart_node(current_scope(), _cell(selector), node)
    click.echo(f"Node restarting: {node}")


@command.command("stop")
@click.argument("selector")
@click.argument("node")
@scope_options
def stop(selector: str, node: str) -> None:
    """Stop NODE of the dataflow SELECTOR for good; its neighbours see their input closed."""
    stop_node(current_scope(), _cell(selector), node)
    click.echo(f"Node stopping: {node}")


def _cell(selector: str) -> Cell:
    return Selector(selector).find(Bus(current_scope()))
