"""The notify sockets of nodes: hears what the nodes say, and from whom.

Each node has a socket of its own, so that one that says too much only holds up itself. A message is
believed if the kernel knows its sender to be in the cgroup of the node.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import NODE_PREFIX
from dora_systemd.adapters.cgroup.members import is_member
from dora_systemd.adapters.host.notify_socket import NotifySocket, Pending
from dora_systemd.decisions.signs.judge import Clock, period_of
from dora_systemd.decisions.signs.messages import Message, parse_message
from dora_systemd.decisions.signs.table import Sign
from dora_systemd.decisions.signs.watchdogs import Watchdogs, watchdog_of
from dora_systemd.paths import CellPaths
from dora_systemd.runner.signs.none import NoSigns
from dora_systemd.values import INFINITY, SECOND

_AT_ONCE = 32
_PAUSE_SECONDS = 0.01
"""A node that sends more than _AT_ONCE messages in this time has to wait."""
_DRAIN = 1024
"""Messages read before a node is ended, more than net.unix.max_dgram_qlen usually allows."""
_REFUSALS = 60 * SECOND
"""µs between two events about messages that are not believed, for each node."""


def _monotonic_us() -> int:
    return time.monotonic_ns() // 1000


@dataclass
class Ear:
    """The socket of one node, and what its present process has said.

    limit: µs, INFINITY without a watchdog. at_us: CLOCK_MONOTONIC of the last WATCHDOG=1, or 0.
    signed: the same by the Clock, or None. refused_us: CLOCK_MONOTONIC of the last such event.
    """

    socket: NotifySocket
    limit: int
    status: str = ""
    at_us: int = 0
    signed: int | None = None
    is_triggered: bool = False
    refused_us: int | None = None

    def hear(self, message: Message, clock: Clock) -> None:
        """Take note of a message that came now."""
        if message.is_alive:
            self.at_us, self.signed = clock.seen, clock.now
        self.is_triggered |= message.is_trigger
        self.status = self.status if message.status is None else message.status

    def forget(self) -> None:
        """The process has ended."""
        self.status, self.at_us, self.signed, self.is_triggered = "", 0, None, False


class Signs(NoSigns):
    """The sockets of the nodes that `watchdogs` gives one. unit: its cgroup directory.

    tell: writes a life event. is_in: whether a process is in a group. clock_us: CLOCK_MONOTONIC.
    on_news: is called after each message.
    """

    is_used = True

    def __init__(
        self,
        watchdogs: Watchdogs,
        unit: Path,
        paths: CellPaths,
        tell: Callable[..., None],
        is_in: Callable[[Path, int], bool] = is_member,
        clock_us: Callable[[], int] = _monotonic_us,
    ) -> None:
        self._watchdogs = watchdogs
        self._unit = unit
        self._paths = paths
        self._tell = tell
        self._is_in = is_in
        self._clock_us = clock_us
        self._loop = asyncio.get_running_loop()
        self._ears: dict[str, Ear] = {}
        limits = filter(None, watchdogs.values())
        self.clock = Clock(period_of(limits), clock_us())
        self.on_news: Callable[[], None] = lambda: None

    def make(self, node: str) -> None:
        """Open the socket of a node, unless it has one, or none. Raises OSError."""
        limit = watchdog_of(self._watchdogs, node)
        if limit and node not in self._ears:
            self._ears[node] = ear = Ear(NotifySocket(self._paths.node_notify(node)), limit)
            self._loop.add_reader(ear.socket, self._read, node, ear)

    def remove(self, node: str) -> None:
        """Close the socket of a node that does not come back."""
        if ear := self._ears.pop(node, None):
            self._loop.remove_reader(ear.socket)
            ear.socket.close()

    def forget(self, node: str) -> None:
        """The node's process has ended: what it has said does not hold for the next one."""
        if ear := self._ears.get(node):
            ear.forget()

    def group(self, node: str) -> Path:
        """The cgroup directory of the node."""
        return self._unit / f"{NODE_PREFIX}{node}"

    def ears(self) -> Iterator[tuple[str, Ear]]:
        """The nodes that have a socket."""
        return iter(list(self._ears.items()))

    def table(self) -> dict[str, Sign]:
        """What the nodes have said, for the table that `list` reads."""
        return {
            node: Sign(one.status, one.at_us, one.limit if one.limit < INFINITY else 0)
            for node, one in self._ears.items()
        }

    def look(self) -> int:
        """Read the clock: the time that has passed for the nodes."""
        self.clock = self.clock.at(self._clock_us())
        return self.clock.now

    def drain(self, node: str, ear: Ear) -> None:
        """Hear what waits in the socket."""
        for _ in range(_DRAIN):
            if not self._take(node, ear):
                return

    def _read(self, node: str, ear: Ear) -> None:
        for _ in range(_AT_ONCE):
            if not self._take(node, ear):
                return
        self._loop.remove_reader(ear.socket)
        self._loop.call_later(_PAUSE_SECONDS, self._go_on, node, ear)

    def _go_on(self, node: str, ear: Ear) -> None:
        if self._ears.get(node) is ear:
            self._loop.add_reader(ear.socket, self._read, node, ear)

    def _take(self, node: str, ear: Ear) -> bool:
        """Hear one message; whether there was one."""
        pending = ear.socket.receive()
        if pending is None:
            return False
        self.look()
        with pending:
            if reason := self._doubt(node, pending):
                self._refuse(node, ear, pending, reason)
            else:
                ear.hear(parse_message(pending.data), self.clock)
                self.on_news()
        return True

    def _doubt(self, node: str, pending: Pending) -> str:
        """Why the message is not believed, or ""."""
        is_own = self._is_in(self.group(node), pending.pid)
        if not pending.is_there():
            return "its sender had exited; one that waits, as systemd-notify does, is known"
        return "" if is_own else f"process {pending.pid} is not in the cgroup of the node"

    def _refuse(self, node: str, ear: Ear, pending: Pending, reason: str) -> None:
        """Report it, but not each time: other processes of this user could fill the journal."""
        now = self.clock.seen
        if ear.refused_us is None or now - ear.refused_us >= _REFUSALS:
            ear.refused_us = now
            self._tell("notify-refused", node, reason=reason, sender=str(pending.pid))
