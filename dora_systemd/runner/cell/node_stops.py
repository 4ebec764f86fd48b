"""Carries out the actions of a stop that has an order: dora's StopNode, signals, and the timers.

dora would kill each node at 1.5 times the grace duration of its StopNode, and cannot change that
any more when the node extends its time. So dora gets a duration that never ends before
`stop_limit`, and the signals come from here.
"""

import asyncio
import contextlib
from collections.abc import Callable
from signal import SIGTERM

from dora_systemd.adapters.cgroup.groups import NODE_PREFIX, kill_group, signal_group
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.node_table import held, lacking
from dora_systemd.decisions.life.states import EndNode, GiveTime, NodeAction, State, StopNode
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Tasks
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.nodes.watchdog import monotonic_us
from dora_systemd.values import INFINITY, SECOND

MonotonicUs = Callable[[], int]
_ENDLESS = 2**62
"""µs, with an infinite stop_limit: the table that `list` reads has no such numbers."""


class NodeStops:
    """The stop of the nodes of one run. tasks: of that run."""

    def __init__(
        self,
        pump: Pump,
        dora: Engine,
        nodes: Nodes,
        tasks: Tasks,
        clock_us: MonotonicUs = monotonic_us,
    ) -> None:
        self._pump, self._engine, self._nodes, self._tasks = pump, dora, nodes, tasks
        self._clock_us = clock_us
        self._loop = asyncio.get_running_loop()
        self._began_us: int | None = None
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._ends_us: dict[str, int] = {}
        nodes.stop_dues.clear()  # of the run before
        if nodes.notify_sockets:
            nodes.notify_sockets.on_extend = self.extend

    def perform(self, action: NodeAction) -> None:
        match action:
            case StopNode():
                self._begin()
                self._tasks.spawn(f"stop node {action.node}", self._stop(action.node))
                self._set_timer(action.node, action.after)
            case EndNode():
                self._end(action)
            case GiveTime():
                self._give(action)
        if not isinstance(action, GiveTime):  # that can come very often
            self._pump.refresh()

    def _begin(self) -> int:
        """Return when the stop has begun, by CLOCK_MONOTONIC."""
        if self._began_us is None:
            self._began_us = self._clock_us()
            self._nodes.let_go()
        return self._began_us

    async def _stop(self, node: str) -> None:
        cell = self._pump.cell
        never = 2 * cell.stop_limit
        params = protocol.node_params("StopNode", cell.run, node, never)
        # A refusal means that the node has ended already.
        await self._engine.ask_apart(params, cell.stop_limit / SECOND)
        if node in lacking(self._pump.cell.nodes) or node in held(self._pump.cell.nodes):
            with contextlib.suppress(OSError):  # the node has no gate any more
                self._nodes.gates.leave(node)  # its launcher reads no messages

    def _end(self, action: EndNode) -> None:
        group = self._nodes.places[0] / f"{NODE_PREFIX}{action.node}"
        if action.after is None:
            kill_group(group)
            self._clear(action.node)
        else:
            signal_group(group, SIGTERM, self._pump.cell.nodes[action.node].pid)
            self._set_timer(action.node, action.after)

    def _give(self, action: GiveTime) -> None:
        timer = self._timers.get(action.node)
        if timer is None or timer.when() < self._loop.time() + action.after / SECOND:
            self._set_timer(action.node, action.after)

    def _set_timer(self, node: str, after: int) -> None:
        self._clear(node)
        if after < _ENDLESS:
            self._nodes.stop_dues[node] = self._clock_us() + after
        self._timers[node] = self._loop.call_later(after / SECOND, self._overdue, node)

    def _clear(self, node: str) -> None:
        self._nodes.stop_dues.pop(node, None)
        if timer := self._timers.pop(node, None):
            timer.cancel()

    def _overdue(self, node: str) -> None:
        self._pump.push(life.NodeOverdue(now_us(), node))

    def bound(self, node: str, most: int) -> None:
        """Let a node extend its time to `most` µs from now, but no more: others wait for it."""
        self._ends_us[node] = self._clock_us() + most

    def extend(self, node: str, wanted: int) -> None:
        """Report that a node extends its time, if the stop has begun."""
        if self._began_us is not None and self._pump.cell.state is State.STOPPING:
            passed = self._clock_us() - self._began_us
            wanted = min(wanted, self._ends_us.get(node, INFINITY) - self._clock_us())
            self._pump.push(life.NodeExtends(now_us(), node, wanted, passed))
