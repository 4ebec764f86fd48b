"""The dora of a machine that is one of several."""

import asyncio
import signal
from collections.abc import Callable, Mapping, Sequence

from dora_systemd.adapters.dora import engine
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.machines.wire import Forwards, Part
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, start_coordinator, start_daemon
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.machines.zenoh import head_arguments, member_arguments, shared_environment

ASK_SECONDS = 5.0
"""A coordinator that waits for a machine answers nobody for half a minute."""
NOISE = (
    b"Gossip is disabled: cannot de-duplicate",
    b"Scouting delay elapsed before start conditions are met",
    b"peer daemon disconnected",
    b"WS coordinator connection error",
)
"""Warnings about what zenoh-machines.json5 wants, and about machines: we tell more of those."""


class SharedEngine(Engine):
    """The dora of a head or a member. machine: the name of its daemon, "" on the head."""

    machine = ""

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
        boot: EarlyDaemon | None = None,
    ) -> None:
        super().__init__(dora, paths, shared_environment(environment, addresses), boot)
        self._addresses = addresses

    async def heartbeats(self) -> list[tuple[str, int]]:
        """The machine of each daemon that is connected, and µs since it was heard.

        Raises DoraSystemdError.
        """
        reply = await self.ask_soon(protocol.CONNECTED_DAEMONS)
        return protocol.parse_heartbeats(reply)

    async def ask_soon(self, params: protocol.Params) -> protocol.Reply:
        """Send a request. Raises DoraSystemdError, also if ASK_SECONDS are not enough."""
        try:
            async with asyncio.timeout(ASK_SECONDS):
                return await self.ask(params)
        except TimeoutError as error:
            raise DoraSystemdError("the dora coordinator does not answer") from error

    async def is_joined(self) -> bool:
        """Whether the daemon of this machine has registered."""
        return any(machine == self.machine for machine, _ in await self.heartbeats())


class HeadEngine(SharedEngine):
    """Coordinator and daemon of the head, on ports that all machines know."""

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
        ports: Forwards,
        on_access: Callable[[str], None],
        boot: EarlyDaemon | None = None,
    ) -> None:
        super().__init__(dora, paths, environment, addresses, boot)
        self._ports, self._on_access = ports, on_access

    def _spawn_coordinator(self) -> engine.Child:
        return start_coordinator(
            self._dora, self._paths, self._environment, self._ports.coordinator
        )

    def _spawn_daemon(self, environment: Mapping[str, str]) -> Daemon:
        more = head_arguments(self._ports, environment, self._addresses)
        return start_daemon(self._dora, self._paths, self._port, environment, more=more)

    def set_port(self, port: int) -> None:
        """Set the port of the coordinator, and tell the members."""
        super().set_port(port)
        self._on_access(self._token)


class MemberEngine(SharedEngine):
    """The daemon of a member; its coordinator is on the head."""

    _part: Part

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
        machine: str,
        boot: EarlyDaemon | None = None,
    ) -> None:
        super().__init__(dora, paths, environment, addresses, boot)
        self.machine = machine

    def set_part(self, part: Part) -> None:
        """Set how to reach the head. That is in memory only."""
        self._part, self._port, self._token = part, part.coordinator, part.token

    def _spawn_daemon(self, environment: Mapping[str, str]) -> Daemon:
        more = member_arguments(self._part, environment, self._addresses)
        return start_daemon(self._dora, self._paths, self._port, environment, self._token, more)

    def cut_off(self) -> None:
        """Kill the daemon, because its coordinator is gone.

        It would look for one again at the same port of 127.0.0.1, show it the token, and start
        what it is told to. The link is gone as well, so any user here can listen there.
        """
        if daemon := self._children.get("daemon"):
            daemon.send_signal(signal.SIGKILL)

    def _write_access(self, daemon: Daemon) -> None:
        """Requests to the coordinator are the head's."""

    async def find_silent(self, seconds: float) -> str:
        """Nothing: the head sees whether the daemon hangs."""
        del seconds
        return ""
