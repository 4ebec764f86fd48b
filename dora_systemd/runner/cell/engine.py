"""The runner's side of dora: its two processes, and the connections to the coordinator."""

import asyncio
import json
import signal
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

from dora_systemd.adapters.dora import control, engine
from dora_systemd.adapters.host import files
from dora_systemd.decisions.dora import protocol
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.begin import Daemon, read_token, start_coordinator, start_daemon
from dora_systemd.runner.cell.boot import Boot, EarlyDaemon
from dora_systemd.values import SECOND

POLL_SECONDS = 0.002
"""Poll interval while the daemon registers: dora sends no event for that."""

KILL_SECONDS = 0.5
"""Time for SIGKILL to take effect; systemd deals with a process that sleeps in the kernel longer.
"""

SILENCE = 20
"""Seconds without a heartbeat of the daemon, after which it counts as hung; it sends one every 5 s.
"""

OnRecord = Callable[[protocol.LogRecord], None]


class Engine:
    """The coordinator and daemon of a cell, and requests to them.

    environment: that of the nodes, without systemd's own variables. boot: of the first run. port:
    of the coordinator, 0 for any. more: arguments of the daemon. on_token: takes the token of the
    coordinator, once that listens.
    """

    def __init__(
        self,
        dora: str,
        paths: CellPaths,
        environment: Mapping[str, str],
        boot: EarlyDaemon | None = None,
        port: int = 0,
        more: Sequence[str] = (),
        on_token: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._boot = boot
        self._wanted_port, self._more, self._on_token = port, more, on_token
        self._dora = dora
        self._paths = paths
        self._environment = dict(environment)
        self._children: dict[str, engine.Child] = {}
        self._requests: control.Connection | None = None
        self._lock = asyncio.Lock()
        self._port = 0
        self._held: socket.socket | None = None
        self._token = ""

    def start_coordinator(self) -> engine.Child:
        """Start the coordinator, unless it boots already; it prints its port.

        Raises as start_coordinator() does.
        """
        boot = self._boot if isinstance(self._boot, Boot) else None
        child = boot.coordinator if boot else None
        if child is None:
            given = (self._dora, self._paths, self._environment)
            child = start_coordinator(*given, self._wanted_port)
        self._children[child.label] = child
        return child

    def wait_boot(self) -> None:
        """Wait until the thread of the boot reads the coordinator's output no more.

        Two readers would take lines from each other, and the port would be lost.
        """
        if self._boot:
            self._boot.daemon()

    def set_port(self, port: int) -> None:
        """Set the port of the coordinator, which has written its token by now. Raises OSError."""
        self._port, self._token = port, read_token(self._paths)
        self._on_token(self._token)

    def start_daemon(self, added: Mapping[str, str]) -> engine.Child:
        """Start the daemon with `added` variables, unless it boots already; write the control file.

        Raises OSError.
        """
        daemon = self._boot.daemon() if self._boot else None
        if daemon is None:
            given = (self._dora, self._paths, self._port, {**self._environment, **added})
            daemon = start_daemon(*given, self._token, self._more)
        self._children[daemon.child.label] = daemon.child
        self._held = daemon.held
        self._write_access(daemon)
        return daemon.child

    def _write_access(self, daemon: Daemon) -> None:
        access = {"port": self._port, "token": self._token, "local_listen_port": daemon.listen}
        files.write_atomic(self._paths.control, json.dumps(access), 0o600)

    async def wait_joined(self) -> None:
        """Connect to the coordinator, and return once the daemon has registered."""
        self._requests = await self.connect()
        while not await self.is_joined():
            await asyncio.sleep(POLL_SECONDS)

    async def is_joined(self) -> bool:
        """Whether the daemon has registered. Raises DoraSystemdError without an answer."""
        reply = await self.ask(protocol.DAEMON_CONNECTED)
        return bool(protocol.result_of(reply, "DaemonConnected"))

    async def find_silent(self, seconds: float) -> str:
        """Find the process that hangs, "coordinator" or "daemon", or "" if both respond.

        seconds: timeout for the coordinator's answer. The request does not involve the daemon: dora
        would then keep the coordinator from answering anything else for 30 s.
        """
        try:
            async with asyncio.timeout(seconds):
                reply = await self.ask(protocol.CONNECTED_DAEMONS)
        except TimeoutError:
            return "coordinator"
        return "" if protocol.parse_heartbeat(reply) <= SILENCE * SECOND else "daemon"

    async def ask(self, params: protocol.Params) -> protocol.Reply:
        """Send a request that dora answers at once."""
        assert self._requests is not None
        async with self._lock:
            return await self._requests.request(params)

    async def ask_apart(self, params: protocol.Params, seconds: float) -> protocol.Reply:
        """Send a request that may take long, on its own connection, because each is serial."""
        with closing(await self.connect()) as connection:
            return await connection.request(params, seconds)

    async def connect(self) -> control.Connection:
        """Open a new connection to the coordinator."""
        return await control.Connection.open(self._port, self._token)

    async def start_run(self, descriptor: Mapping[str, Any], name: str) -> str:
        """Send the descriptor; return dora's id of the run. Raises DoraSystemdError."""
        params = protocol.start_params(descriptor, name, str(self._paths.work))
        reply = await self.ask(params)
        return str(protocol.result_of(reply, "DataflowStartTriggered")["uuid"])

    async def read_events(
        self, run: str, on_start: Callable[[], object], on_record: OnRecord
    ) -> bool:
        """Subscribe to a run, call on_start, and pass its events to on_record until the end.

        Return True if only the subscription has ended, and not the run. Raises
        DoraSystemdError if dora does not know the run.
        """
        with closing(await self.connect()) as connection:
            reply = await connection.request(protocol.subscribe_params(run))
            if reply.error:
                raise DoraSystemdError(f"cannot read events of dora: {reply.error}")
            on_start()
            return await connection.read_events(on_record)

    def is_exiting(self) -> bool:
        """Return whether coordinator or daemon has exited or is exiting."""
        return any(child.is_exiting() for child in self._children.values())

    def dismiss_daemon(self) -> bool:
        """Have the daemon exit properly; False if it has exited already."""
        daemon = self._children.get("daemon")
        if daemon is None or daemon.popen.returncode is not None:
            return False
        # SIGTERM would kill the daemon at once. On SIGINT it cleans up, in half the time of the
        # protocol's Destroy.
        daemon.send_signal(signal.SIGINT)
        return True

    def kill(self) -> None:
        """Kill and reap coordinator and daemon, and close the connection."""
        if self._requests is not None:
            self._requests.close()
        boot, self._boot = self._boot, None
        if boot and (daemon := boot.daemon()):
            self._children[daemon.child.label], self._held = daemon.child, daemon.held
        if self._held:
            self._held.close()
        for child in self._children.values():
            child.send_signal(signal.SIGKILL)
        for child in self._children.values():
            child.close(asyncio.get_running_loop(), KILL_SECONDS)
        self._children.clear()
