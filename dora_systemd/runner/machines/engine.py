"""The dora of a machine that is one of several."""

import asyncio
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.dora import engine
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.machines.address import LOOPBACK, endpoint
from dora_systemd.decisions.machines.wire import Part
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, start_coordinator, start_daemon
from dora_systemd.runner.cell.engine import Engine

ASK_SECONDS = 5.0
"""A coordinator that waits for a machine answers nobody for half a minute."""
_ZENOH = Path(__file__).parents[2] / "zenoh-machines.json5"
_NO_DIRECT = {"DORA_ZENOH_ENDPOINT_EXCHANGE_TIMEOUT_MS": "0"}
"""Where ssh carries the messages, nodes of different machines do not dial each other: the addresses
would be those of 127.0.0.1. So dora must not wait for them either; it would for 1.5 s."""
NOISE = (
    b"Gossip is disabled: cannot de-duplicate",
    b"Scouting delay elapsed before start conditions are met",
    b"peer daemon disconnected",
    b"WS coordinator connection error",
)
"""Warnings about what zenoh-machines.json5 wants, and about machines: we tell more of those."""
_OVERLAYS = ("ZENOH_CONFIG", "DORA_ZENOH_CONFIG_OVERLAY")
"""Variables by which a user sets the same: dora refuses both."""


def zenoh_arguments(port: int, environment: Mapping[str, str], address: str) -> tuple[str, ...]:
    """What a daemon needs to meet those of other machines. address: where it listens."""
    has_own = any(name in environment for name in _OVERLAYS)
    overlay = () if has_own else ("--zenoh-config-overlay", str(_ZENOH))
    return ("--zenoh-listen", endpoint(address, port), *overlay)


class SharedEngine(Engine):
    """The dora of a head or a member. machine: the name of its daemon, "" on the head.

    addresses: of the options; the daemon listens on the first one.
    """

    machine = ""

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
    ) -> None:
        more = {} if addresses else _NO_DIRECT
        super().__init__(dora, paths, {**environment, **more})
        self._address = [*addresses, LOOPBACK][0]

    async def machines(self) -> list[str]:
        """The machines whose daemon is connected. Raises DoraSystemdError."""
        reply = await self.ask_soon(protocol.CONNECTED_DAEMONS)
        return protocol.parse_machines(reply)

    async def ask_soon(self, params: protocol.Params) -> protocol.Reply:
        """Send a request. Raises DoraSystemdError, also if ASK_SECONDS are not enough."""
        try:
            async with asyncio.timeout(ASK_SECONDS):
                return await self.ask(params)
        except TimeoutError as error:
            raise DoraSystemdError("the dora coordinator does not answer") from error

    async def is_joined(self) -> bool:
        """Whether the daemon of this machine has registered."""
        return self.machine in await self.machines()


class HeadEngine(SharedEngine):
    """Coordinator and daemon of the head, on ports that all machines know."""

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
        ports: tuple[int, int],
        on_access: Callable[[str], None],
    ) -> None:
        super().__init__(dora, paths, environment, addresses)
        self._ports, self._on_access = ports, on_access

    def _spawn_coordinator(self) -> engine.Child:
        return start_coordinator(self._dora, self._paths, self._environment, self._ports[0])

    def _spawn_daemon(self, environment: Mapping[str, str]) -> Daemon:
        more = zenoh_arguments(self._ports[1], environment, self._address)
        return start_daemon(self._dora, self._paths, self._port, environment, more=more)

    def set_port(self, port: int) -> None:
        """Set the port of the coordinator, and tell the members."""
        super().set_port(port)
        self._on_access(self._token)


class MemberEngine(SharedEngine):
    """The daemon of a member; its coordinator is on the head."""

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        addresses: Sequence[str],
        machine: str,
    ) -> None:
        super().__init__(dora, paths, environment, addresses)
        self.machine, self._zenoh = machine, 0

    def set_part(self, part: Part) -> None:
        """Set how to reach the head. That is in memory only."""
        self._port, self._token, self._zenoh = part.coordinator, part.token, part.zenoh

    def _spawn_daemon(self, environment: Mapping[str, str]) -> Daemon:
        zenoh = zenoh_arguments(self._zenoh, environment, self._address)
        more = ("--machine-id", self.machine, *zenoh)
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
