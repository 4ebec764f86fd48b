"""Open one port for all dataflows."""

import os

import click

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import Edge
from dora_systemd.cli.parameters import acting_options, current_scope, print_outcomes, tell
from dora_systemd.decisions.gateway.place import SOCKET_UNIT, wanted_port
from dora_systemd.decisions.views.outcome import Outcome, Thing
from dora_systemd.scope import Scope
from dora_systemd.verbs.gateway import check_answer, read_gateway
from dora_systemd.verbs.up import check_machine, make_state, open_port, start_boot_target

_USE = """

Use 'eval "$({} env)"' to connect the dora command to it"""
_USE_THERE = """

Use 'doractl dora NAME -- ARGUMENT...' to run the dora command there"""


@click.command("up")
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    metavar="PORT",
    help="Port of 127.0.0.1 to listen on; default: DORA_DAEMON_PORT, or 53290.",
)
@acting_options
def command(port: int | None) -> int:
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
        return _print_port(scope, "Daemon already running", now.port)
    tell("Starting dora daemon...")
    check_machine(Bus, scope)
    make_state(scope)  # before a client can have systemd start the gateway
    opened = open_port(bus, scope, wanted)
    tell(f"  ✓ Coordinator started on port {opened}")
    names = start_boot_target(bus, scope)
    check_answer(scope, opened)
    tell("  ✓ Daemon ready")
    if names:
        tell(f"  ✓ Enabled dataflows started: {', '.join(names)}")
    return _print_port(scope, "\nDaemon running", opened, names)


def _print_port(scope: Scope, text: str, port: int, started: list[str] | None = None) -> int:
    """started: the enabled dataflows that were started, None if the port was open before."""
    url = f"http://localhost:{port}"
    details = {"port": port, "url": url, "started": started or []}
    is_news = started is not None
    use = _USE_THERE if Edge.reached_as else _USE.format(scope.command)
    outcome = Outcome(Thing(SOCKET_UNIT), f"{text} at: {url}{use}", "", is_news, "", details)
    return print_outcomes([outcome])
