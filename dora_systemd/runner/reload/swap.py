"""Replaces single nodes of a dataflow while it runs.

dora has two requests for this, and neither is enough. RestartNode ends the old process, but starts
the new one only after the node's restart delay. ReplaceNode starts the new process while the old
one still runs. The Swapper sends one after the other: RestartNode ends the old process within its
grace period, and ReplaceNode starts the new one at once. The setting that starts the new process
first needs only ReplaceNode. Other inputs or outputs need RemoveNode and AddNode.

The Swapper sends requests, and the pump hears of their effect: exits and readiness arrive as
events of the run. So each method first pushes the event that marks the node as reloading in the
live table, and only then asks dora. In the other order the old state "running" would satisfy the
wait for the new process.
"""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.life.view import initial_nodes
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.values import SECOND, format_duration

_ANSWER_SECONDS = 30.0
"""Timeout for an answer of dora's."""
_READY_SECONDS = 30
_MOST_SECONDS = 600
_STARTS = 4


class NotReady(Exception):
    """The new node has failed or is not ready in time; the message says which."""


def patience(cell: Cell) -> int:
    """Seconds that a new version may take to be ready.

    A machine or a node that is slow needs longer, so it depends on how long `cell` took to start.
    """
    start = (cell.ready_us - cell.started_us) // SECOND
    return min(max(_READY_SECONDS, _STARTS * start), _MOST_SECONDS)


class Swapper:
    """Has dora change nodes of the run of `pump`, and waits for the effect."""

    def __init__(self, pump: Pump, dora: Engine) -> None:
        self._pump = pump
        self._engine = dora

    async def swap(self, definition: Mapping[str, Any], kind: str, starts_first: bool) -> None:
        """Replace a node that keeps its inputs and outputs. Raises DoraSystemdError and NotReady.

        definition: the node as dora gets it. kind: as in the live table. starts_first: whether the
        new process starts while the old one runs.
        """
        node = str(definition["id"])
        old = self._pump.cell.nodes[node]
        self._pump.push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        if old.pid and not starts_first and not old.needs and is_restartable(old):
            await self._end(node, "RestartNode")
        await self.ask(protocol.replace_params(self._run, definition))
        await self._wait_ready(node)

    async def hold(self, definition: Mapping[str, Any]) -> None:
        """End the process of a node, and have the next one wait at its closed gate.

        Raises DoraSystemdError if dora has given the node up.
        """
        node = str(definition["id"])
        old = self._pump.cell.nodes[node]
        if old.pid and is_restartable(old):
            # Dora refuses this for a node that is just being started.
            with contextlib.suppress(DoraSystemdError):
                await self._end(node, "RestartNode")
        if self._pump.cell.state is State.RUNNING:  # else a stop has come meanwhile
            await self.ask(protocol.replace_params(self._run, definition))

    async def rewire(self, definition: Mapping[str, Any], kind: str) -> None:
        """Replace a node whose inputs or outputs change. Raises DoraSystemdError and NotReady."""
        node = str(definition["id"])
        self._pump.push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        await self._end(node, "RemoveNode")
        await self.ask(protocol.add_params(self._run, definition))
        await self._wait_ready(node)

    async def add(self, definition: Mapping[str, Any], kind: str) -> None:
        """Add a node, whose pipes must be open. Raises DoraSystemdError and NotReady."""
        node = str(definition["id"])
        self._pump.push(life.NodeAdded(now_us(), node, _status(definition, kind)))
        await self.ask(protocol.add_params(self._run, definition))
        if kind != "dynamic":
            await self._wait_ready(node)

    async def remove(self, node: str) -> None:
        """Remove a node from the run. Raises DoraSystemdError."""
        self._pump.push(life.NodeReloading(now_us(), node))
        await self._end(node, "RemoveNode")
        self._pump.push(life.NodeRemoved(now_us(), node))

    async def reload_operator(self, node: str, operator: str) -> None:
        """Have a Python operator load its file again. Raises DoraSystemdError."""
        await self.ask(protocol.reload_params(self._run, node, operator))

    @property
    def _run(self) -> str:
        return self._pump.cell.run

    async def ask(self, params: protocol.Params) -> None:
        """Send one request to dora. Raises DoraSystemdError if dora refuses it."""
        reply = await self._engine.ask_apart(params, _ANSWER_SECONDS)
        if reply.error:
            raise DoraSystemdError(f"cannot do that in dora: {protocol.first_line(reply.error)}")

    async def _end(self, node: str, method: str) -> None:
        grace = self._pump.cell.grace
        await self.ask(protocol.node_params(method, self._run, node, grace))
        await self._pump.wait(_of(node, lambda one: not one.pid), stop_timeout(grace) / SECOND)

    async def _wait_ready(self, node: str) -> None:
        seconds = patience(self._pump.cell)
        await self._pump.wait(_of(node, _is_settled), seconds)
        state = self._pump.cell.nodes[node]
        if not state.is_alive and not state.needs:
            late = f"not ready within {format_duration(seconds * SECOND)}"
            raise NotReady(f"node {node}: {str(state.exit) or late}")


def _is_settled(node: NodeStatus) -> bool:
    return node.is_alive or node.state in ("failed", "finished", "waiting")


def is_restartable(node: NodeStatus) -> bool:
    """Whether dora would start the node again: only then RestartNode is sent, as a restart."""
    used = node.restarts + (node.state == "restarting")
    return node.policy != "never" and not 0 < node.max_restarts <= used


def _status(definition: Mapping[str, Any], kind: str) -> NodeStatus:
    node = str(definition["id"])
    return initial_nodes({node: kind}, {"nodes": [definition]}, now_us())[node]


def _of(node: str, is_so: Callable[[NodeStatus], bool]) -> Callable[[Cell], bool]:
    return lambda cell: node not in cell.nodes or is_so(cell.nodes[node])
