"""Open one port for all dataflows."""

import os

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.parameters import current_scope, scope_options
from dora_systemd.decisions.gateway.port import wanted_port
from dora_systemd.verbs.gateway import check_answer, read_gateway
from dora_systemd.verbs.up import check_machine, open_port, start_boot_target

_USE = """

Use 'eval "$(doractl env)"' to connect the dora command to it"""


@click.command("up")
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    metavar="PORT",
    help="Port of 127.0.0.1 to listen on; default: DORA_DAEMON_PORT, or 53290.",
)
@scope_options
def command(port: int | None) -> None:
    """Open the port of the gateway, which acts as one coordinator for all dataflows.

    systemd holds the port and starts the gateway on the first connection. Dataflows, doractl start
    and all other verbs work without it.

    Examples:
      doractl up
      doractl up --port 53291
    """
    scope = current_scope()
    bus = Bus(scope)
    wanted = wanted_port(port, os.environ)
    now = read_gateway(bus)
    if now.is_up and wanted in (None, now.port):
        assert now.port is not None
        check_answer(scope, now.port)
        click.echo(f"Daemon already running at: http://localhost:{now.port}{_USE}")
        return
    click.echo("Starting dora daemon...")
    check_machine(Bus, scope)
    opened = open_port(bus, scope, wanted)
    click.echo(f"  ✓ Coordinator started on port {opened}")
    names = start_boot_target(bus, scope)
    check_answer(scope, opened)
    click.echo("  ✓ Daemon ready")
    if names:
        click.echo(f"  ✓ Enabled dataflows started: {', '.join(names)}")
    click.echo(f"\nDaemon running at: http://localhost:{opened}{_USE}")
