"""The watchdogs of nodes: their notify sockets, and the end of nodes that miss one.

Each node has its own socket, so that a node that sends too much only delays itself. A message is
accepted if its sender is in the cgroup of the node, according to the kernel. A node that misses its
watchdog is ended as systemd ends a service: by SIGABRT, then by SIGKILL. dora then restarts the
node by its policy, as after any other crash.
"""

import asyncio
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from signal import SIGABRT, Signals
from typing import Protocol

from dora_systemd.adapters.cgroup.groups import NODE_PREFIX, is_member, signal_processes
from dora_systemd.adapters.host.notify_socket import NotifySocket, Pending
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.watchdog.judge import (
    TRIGGERED,
    Act,
    Clock,
    Phase,
    Watch,
    limit_in,
    missed,
    period_of,
)
from dora_systemd.decisions.watchdog.messages import Message, Sign, parse_message
from dora_systemd.decisions.watchdog.watchdogs import Watchdogs, watchdog_of
from dora_systemd.paths import CellPaths
from dora_systemd.values import INFINITY, SECOND

_AT_ONCE = 32
_PAUSE_SECONDS = 0.01
"""A node that sends more than _AT_ONCE messages in this time has to wait."""
_DRAIN = 1024
"""Messages read before a node is ended, more than net.unix.max_dgram_qlen usually allows."""
_REFUSALS = 60 * SECOND
"""µs between two events about refused messages, for each node."""
_PUBLISH_SECONDS = 1.0
"""Shortest time between two tables that are written because of nodes' messages."""


def monotonic_us() -> int:
    """Read CLOCK_MONOTONIC in µs."""
    return time.monotonic_ns() // 1000


@dataclass
class NodeSocket:
    """The socket of one node, and what its present process has sent."""

    socket: NotifySocket
    limit: int  # µs, INFINITY without a watchdog
    status: str = ""
    at_us: int = 0  # CLOCK_MONOTONIC of the last WATCHDOG=1, or 0
    signed: int | None = None  # time of that message by the Clock, or None
    is_triggered: bool = False
    refused_us: int | None = None  # CLOCK_MONOTONIC of the last event about a refused message

    def receive(self, message: Message, clock: Clock) -> None:
        """Record a message that came now."""
        if message.is_alive:
            self.at_us, self.signed = clock.seen, clock.now
        self.is_triggered |= message.is_trigger
        self.status = self.status if message.status is None else message.status

    def forget(self) -> None:
        """Discard what the process of the node has sent, because the process has ended."""
        self.status, self.at_us, self.signed, self.is_triggered = "", 0, None, False


class NotifySockets:
    """The sockets of the nodes that `watchdogs` gives one. unit: its cgroup directory.

    `tell`: writes a life event. is_in: whether a process is in a group. clock_us: CLOCK_MONOTONIC.
    on_news: is called after each message. on_extend: receives EXTEND_TIMEOUT_USEC= of a node.
    """

    def __init__(
        self,
        watchdogs: Watchdogs,
        unit: Path,
        paths: CellPaths,
        tell: Callable[..., None],
        is_in: Callable[[Path, int], bool] = is_member,
        clock_us: Callable[[], int] = monotonic_us,
    ) -> None:
        self._watchdogs = watchdogs
        self._unit = unit
        self._paths = paths
        self._tell = tell
        self._is_in = is_in
        self._clock_us = clock_us
        self._loop = asyncio.get_running_loop()
        self._by_node: dict[str, NodeSocket] = {}
        limits = filter(None, watchdogs.values())
        self.clock = Clock(period_of(limits), clock_us())
        self.on_news: Callable[[], None] = lambda: None
        self.on_extend: Callable[[str, int], None] = lambda *_: None

    def make(self, node: str) -> None:
        """Create the node's notify socket, if it is configured and does not exist yet.

        Raises OSError.
        """
        limit = watchdog_of(self._watchdogs, node)
        if limit and node not in self._by_node:
            self._by_node[node] = entry = NodeSocket(
                NotifySocket(self._paths.node_notify(node)), limit
            )
            self._loop.add_reader(entry.socket, self._read, node, entry)

    def remove(self, node: str) -> None:
        """Close the socket of a node that will not start again."""
        if entry := self._by_node.pop(node, None):
            self._loop.remove_reader(entry.socket)
            entry.socket.close()

    def forget(self, node: str) -> None:
        """Discard what the ended process of the node sent, before the next process starts."""
        if entry := self._by_node.get(node):
            entry.forget()

    def group(self, node: str) -> Path:
        """The cgroup directory of the node."""
        return self._unit / f"{NODE_PREFIX}{node}"

    def items(self) -> Iterator[tuple[str, NodeSocket]]:
        return iter(list(self._by_node.items()))

    def table(self) -> dict[str, Sign]:
        """Return the last status and watchdog limit of each node, for the table of `list`."""
        return {
            node: Sign(one.status, one.at_us, one.limit if one.limit < INFINITY else 0)
            for node, one in self._by_node.items()
        }

    def look(self) -> int:
        """Read the clock: the time that has passed for the nodes."""
        self.clock = self.clock.at(self._clock_us())
        return self.clock.now

    def drain(self, node: str, entry: NodeSocket) -> None:
        for _ in range(_DRAIN):
            if not self._take(node, entry):
                return

    def _read(self, node: str, entry: NodeSocket) -> None:
        for _ in range(_AT_ONCE):
            if not self._take(node, entry):
                return
        self._loop.remove_reader(entry.socket)
        self._loop.call_later(_PAUSE_SECONDS, self._go_on, node, entry)

    def _go_on(self, node: str, entry: NodeSocket) -> None:
        if self._by_node.get(node) is entry:
            self._loop.add_reader(entry.socket, self._read, node, entry)

    def _take(self, node: str, entry: NodeSocket) -> bool:
        """Receive one message; return whether there was one."""
        pending = entry.socket.receive()
        if pending is None:
            return False
        self.look()
        with pending:
            if reason := self._doubt(node, pending):
                self._refuse(node, entry, pending, reason)
            else:
                message = parse_message(pending.data)
                entry.receive(message, self.clock)
                if message.extend:
                    self.on_extend(node, message.extend)
                self.on_news()
        return True

    def _doubt(self, node: str, pending: Pending) -> str:
        """Return the reason to refuse the message, or ""."""
        is_own = self._is_in(self.group(node), pending.pid)
        if not pending.is_there():
            return "its sender had exited; one that waits, as systemd-notify does, is known"
        return "" if is_own else f"process {pending.pid} is not in the cgroup of the node"

    def _refuse(self, node: str, entry: NodeSocket, pending: Pending, reason: str) -> None:
        """Report a refused message, at a limited rate: other processes could fill the journal."""
        now = self.clock.seen
        if entry.refused_us is None or now - entry.refused_us >= _REFUSALS:
            entry.refused_us = now
            self._tell("notify-refused", node, reason=reason, sender=str(pending.pid))


class Pump(Protocol):
    """The part of runner.cell.pump.Pump that WatchdogTimers uses."""

    cell: Cell

    def push(self, event: life.Event) -> None:
        """Change the cell by one event."""

    def refresh(self) -> None:
        """Write the table that `list` reads."""


class Processes(Protocol):
    """The part of runner.nodes.nodes.Nodes that WatchdogTimers uses."""

    def is_blocked(self, node: str) -> bool:
        """Whether the node may have to wait for the journal."""

    def find_own(self, node: str, pid: int) -> list[int]:
        """Find the processes of the node, unless its next process has replaced `pid`."""

    def clear(self, node: str, pid: int) -> None:
        """Kill the processes of the node, unless its next process has replaced `pid`."""


class WatchdogTimers:
    """Checks the watchdogs of the nodes of one run. send: sends a signal to processes of a cgroup.

    dora may have replaced a process before the runner learns of that: the next process is spared.
    """

    def __init__(
        self,
        sockets: NotifySockets,
        pump: Pump,
        processes: Processes,
        options: RunnerOptions,
        send: Callable[[Path, Signals, Iterable[int]], object] = signal_processes,
    ) -> None:
        self._sockets = sockets
        self._pump = pump
        self._processes = processes
        self._options = options
        self._send = send
        self._loop = asyncio.get_running_loop()
        self._watches: dict[str, Watch] = {}
        self._published = 0.0
        self._timer: asyncio.TimerHandle | None = None

    async def run(self) -> None:
        """Check all nodes once in each period of the clock."""
        self._sockets.on_news = self._hear_news
        try:
            while True:
                await asyncio.sleep(self._sockets.clock.period / SECOND)
                self._look()
        finally:
            if self._sockets.on_news == self._hear_news:  # else the watch of the next run has begun
                self._sockets.on_news = lambda: None
            if self._timer is not None:
                self._timer.cancel()

    def _hear_news(self) -> None:
        if self._timer is None:
            due = max(self._published + _PUBLISH_SECONDS, self._loop.time())
            self._timer = self._loop.call_at(due, self._publish)

    def _publish(self) -> None:
        self._timer, self._published = None, self._loop.time()
        self._pump.refresh()
        if any(entry.is_triggered for _, entry in self._sockets.items()):
            self._look()

    def _look(self) -> None:
        now = self._sockets.look()
        for node, entry in self._sockets.items():
            self._look_at(node, entry, now)

    def _look_at(self, node: str, entry: NodeSocket, now: int) -> None:
        phase, pid = self._phase(self._pump.cell.nodes.get(node))
        watch = self._watches.get(node, Watch()).of(phase, pid, entry.signed, now)
        if self._processes.is_blocked(node):
            watch = watch.excused(now)
        limit = limit_in(phase, entry.limit, self._options.start_timeout)
        act = watch.act(limit, self._options.grace, now)
        if act is Act.ABORT:  # a sign may still be in the socket
            self._sockets.drain(node, entry)
            watch = watch.of(phase, pid, entry.signed, now)
            act = watch.act(limit, self._options.grace, now)
        is_asked = entry.is_triggered and watch.is_awake
        if act is Act.KILL:
            watch = watch._replace(is_killed=True)
            self._processes.clear(node, pid)
        elif (act is Act.ABORT or is_asked) and (own := self._processes.find_own(node, pid)):
            watch = watch._replace(aborted=now)
            self._abort(node, entry, own, TRIGGERED if is_asked else missed(phase, limit))
        self._watches[node] = watch

    def _phase(self, status: NodeStatus | None) -> tuple[Phase, int]:
        """Return the phase of the node, as far as it matters to the watchdog, and its pid."""
        if status is None or not status.pid or self._pump.cell.state is not State.RUNNING:
            return Phase.AWAY, 0
        phases = {"starting": Phase.STARTING, "running": Phase.RUNNING}
        phase = phases.get(status.state, Phase.AWAY)
        return phase, status.pid if phase is not Phase.AWAY else 0

    def _abort(self, node: str, entry: NodeSocket, own: list[int], reason: str) -> None:
        details = {"status": entry.status} if entry.status else {}
        at_us = time.time_ns() // 1000
        self._pump.push(life.NodeHung(at_us, node, reason, "node-watchdog", details))
        self._send(self._sockets.group(node), SIGABRT, own)
