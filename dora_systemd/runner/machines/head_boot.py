"""What a head does before it imports the rest of the runner: its links wait for the ports.

Imports only what loads quickly.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from dora_systemd.adapters.runner_socket.door import Door
from dora_systemd.decisions.cell.machines import members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.wire import Forwards, format_message
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, start_coordinator, start_daemon
from dora_systemd.runner.cell.boot import Boot
from dora_systemd.runner.machines.ports import choose_ports
from dora_systemd.runner.machines.zenoh import head_arguments, shared_environment

GREETED = "greeted"
"""A key of a request for a session that has got its ports already."""


class HeadBoot(Boot):
    """The dora of a head, on ports that all machines know. door: tells them the links."""

    def __init__(
        self, options: RunnerOptions, paths: CellPaths, unit: Path, environment: Mapping[str, str]
    ) -> None:
        members = members_of(options.placed)
        self._addresses = options.addresses
        self.ports = choose_ports(members, options.addresses)
        told = forwards(options, self.ports)
        self.door = Door(paths.socket, lambda line: greeting(line, members, told))
        own = shared_environment(environment, options.addresses)
        try:
            coordinator = start_coordinator(options.dora, paths, own, self.ports.coordinator)
        except (OSError, DoraSystemdError):
            self.door.close()
            raise
        super().__init__(coordinator, options, paths, unit, own)

    def _spawn_daemon(self) -> Daemon:
        more = head_arguments(self.ports, self._environment, self._addresses)
        return start_daemon(self._dora, self._paths, self._port, self._environment, more=more)


def forwards(options: RunnerOptions, ports: Forwards) -> Forwards:
    """What a link is told. Without ssh on the way, zenoh's ports are those of other addresses."""
    return replace(ports, zenoh={}) if options.addresses else ports


def greeting(line: bytes, members: tuple[str, ...], ports: Forwards) -> tuple[bytes, bytes]:
    """The ports for a link, and its request without another wish for them; see Greet."""
    try:
        request = json.loads(line)
        is_link = request.get("verb") == "link" and request.get("machine") in members
    except (ValueError, AttributeError, TypeError, RecursionError):
        is_link = False
    if not is_link:
        return b"", line
    return format_message(ports), json.dumps({**request, GREETED: True}).encode()
