"""Ends nodes that miss their watchdog, as systemd ends a service: by SIGABRT, then by SIGKILL.

dora then restarts the node by its policy, as after any other crash.
"""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from signal import SIGABRT, Signals
from typing import Protocol

from dora_systemd.adapters.cgroup.groups import kill_group
from dora_systemd.adapters.cgroup.members import signal_group
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.signs.judge import TRIGGERED, Act, Phase, Watch, limit_in, missed
from dora_systemd.runner.signs.none import NoSigns
from dora_systemd.runner.signs.sockets import Ear, Signs
from dora_systemd.values import SECOND

_PUBLISH_SECONDS = 1.0
"""Shortest time between two tables that are written because of what nodes say."""


IsBlocked = Callable[[str], bool]
"""Whether a node may have to wait for the journal."""


class Pump(Protocol):
    """The part of dora_systemd.runner.cell.pump.Pump that SignWatch uses."""

    cell: Cell

    def push(self, event: life.Event) -> None:
        """Take one event through the table."""

    def refresh(self) -> None:
        """Write the table that `list` reads."""


async def watch_nodes(
    signs: NoSigns, pump: Pump, is_blocked: IsBlocked, options: RunnerOptions
) -> None:
    """Watch over the nodes of one run of the dataflow, until this task is cancelled."""
    if isinstance(signs, Signs):
        await SignWatch(signs, pump, is_blocked, options).run()


class SignWatch:
    """Watches over the nodes of one run of the dataflow. send: sends a signal to a group."""

    def __init__(
        self,
        signs: Signs,
        pump: Pump,
        is_blocked: IsBlocked,
        options: RunnerOptions,
        send: Callable[[Path, Signals, int], None] = signal_group,
    ) -> None:
        self._signs = signs
        self._pump = pump
        self._is_blocked = is_blocked
        self._options = options
        self._send = send
        self._loop = asyncio.get_running_loop()
        self._watches: dict[str, Watch] = {}
        self._published = 0.0
        self._timer: asyncio.TimerHandle | None = None

    async def run(self) -> None:
        """Look at all nodes again and again."""
        self._signs.on_news = self._hear_news
        try:
            while True:
                await asyncio.sleep(self._signs.clock.period / SECOND)
                self._look()
        finally:
            if self._signs.on_news == self._hear_news:  # else the watch of the next run has begun
                self._signs.on_news = lambda: None
            if self._timer is not None:
                self._timer.cancel()

    def _hear_news(self) -> None:
        if self._timer is None:
            due = max(self._published + _PUBLISH_SECONDS, self._loop.time())
            self._timer = self._loop.call_at(due, self._publish)

    def _publish(self) -> None:
        self._timer, self._published = None, self._loop.time()
        self._pump.refresh()
        if any(ear.is_triggered for _, ear in self._signs.ears()):
            self._look()

    def _look(self) -> None:
        now = self._signs.look()
        for node, ear in self._signs.ears():
            self._look_at(node, ear, now)

    def _look_at(self, node: str, ear: Ear, now: int) -> None:
        phase, pid = self._phase(self._pump.cell.nodes.get(node))
        watch = self._watches.get(node, Watch()).of(phase, pid, ear.signed, now)
        if self._is_blocked(node):
            watch = watch.excused(now)
        limit = limit_in(phase, ear.limit, self._options.start_timeout)
        act = watch.act(limit, self._options.grace, now)
        if act is Act.ABORT:  # a sign may still be in the socket
            self._signs.drain(node, ear)
            watch = watch.of(phase, pid, ear.signed, now)
            act = watch.act(limit, self._options.grace, now)
        is_asked = ear.is_triggered and watch.is_awake
        if act is Act.ABORT or is_asked:
            watch = watch._replace(aborted=now)
            self._abort(node, ear, pid, TRIGGERED if is_asked else missed(phase, limit))
        elif act is Act.KILL:
            watch = watch._replace(is_killed=True)
            kill_group(self._signs.group(node))
        self._watches[node] = watch

    def _phase(self, status: NodeStatus | None) -> tuple[Phase, int]:
        """What the node is doing, as far as it can miss its watchdog."""
        if status is None or not status.pid or self._pump.cell.state is not State.RUNNING:
            return Phase.AWAY, 0
        phases = {"starting": Phase.STARTING, "running": Phase.RUNNING}
        phase = phases.get(status.state, Phase.AWAY)
        return phase, status.pid if phase is not Phase.AWAY else 0

    def _abort(self, node: str, ear: Ear, pid: int, reason: str) -> None:
        details = {"status": ear.status} if ear.status else {}
        at_us = time.time_ns() // 1000
        self._pump.push(life.NodeHung(at_us, node, reason, "node-watchdog", details))
        self._send(self._signs.group(node), SIGABRT, pid)
