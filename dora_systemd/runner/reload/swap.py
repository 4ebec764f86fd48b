"""How the runner replaces single nodes of a dataflow that runs.

dora's RestartNode does not start what it has ended before the node's restart delay is over, and
its ReplaceNode starts the new node while the old one still runs. One after the other they do what
is wanted: the old one ends as it should, and the new one starts at once.
"""

from collections.abc import Callable, Mapping
from typing import Any

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.life.view import initial_nodes
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.parts import CellDora
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.values import SECOND, format_duration

READY_SECONDS = 30.0
"""How long a reloaded node may take to be ready, before it counts as failed."""

_READY = ("ready", "running", "dynamic")
_SETTLED = (*_READY, "failed", "finished")


class NotReady(Exception):
    """The new node has failed, or takes too long; it says how."""


class Swapper:
    """Asks dora to change nodes of the run of `pump`, and waits until it has."""

    def __init__(self, pump: Pump, dora: CellDora) -> None:
        self._pump = pump
        self._engine = dora

    async def swap(self, definition: Mapping[str, Any], kind: str, starts_first: bool) -> None:
        """Put a new node in the place of one. Raises DoraSystemdError and NotReady.

        definition: what dora is sent. kind: as in the live table.
        """
        node = str(definition["id"])
        old = self._pump.cell.nodes[node]
        self._push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        if old.pid and not starts_first and _is_restartable(old):
            await self._end(node, "RestartNode")
        await self._ask(protocol.replace_params(self._run, definition))
        await self._wait_ready(node)

    async def rewire(self, definition: Mapping[str, Any], kind: str) -> None:
        """The same for a node with other inputs or outputs. Raises the same."""
        node = str(definition["id"])
        self._push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        await self._end(node, "RemoveNode")
        await self._ask(protocol.add_params(self._run, definition))
        await self._wait_ready(node)

    async def add(self, definition: Mapping[str, Any], kind: str) -> None:
        """Add a node, whose pipes are open. Raises DoraSystemdError and NotReady."""
        node = str(definition["id"])
        self._push(life.NodeAdded(now_us(), node, _status(definition, kind)))
        await self._ask(protocol.add_params(self._run, definition))
        if kind != "dynamic":
            await self._wait_ready(node)

    async def remove(self, node: str) -> None:
        """Take a node out. Raises DoraSystemdError."""
        self._push(life.NodeReloading(now_us(), node))
        await self._end(node, "RemoveNode")
        self._push(life.NodeRemoved(now_us(), node))

    async def reload_operator(self, node: str, operator: str) -> None:
        """Have a Python operator read its file again. Raises DoraSystemdError."""
        await self._ask(protocol.reload_params(self._run, node, operator))

    @property
    def _run(self) -> str:
        return self._pump.cell.run

    def _push(self, event: life.Event) -> None:
        self._pump.push(event)

    async def _ask(self, params: protocol.Params) -> None:
        reply = await self._engine.ask_apart(params, READY_SECONDS)
        if reply.error:
            raise DoraSystemdError(f"cannot do that in dora: {protocol.first_line(reply.error)}")

    async def _end(self, node: str, method: str) -> None:
        grace = self._pump.cell.grace
        await self._ask(protocol.node_params(method, self._run, node, grace))
        await self._pump.wait(_of(node, lambda one: not one.pid), stop_timeout(grace) / SECOND)

    async def _wait_ready(self, node: str) -> None:
        await self._pump.wait(_of(node, lambda one: one.state in _SETTLED), READY_SECONDS)
        state = self._pump.cell.nodes[node]
        if state.state not in _READY:
            late = f"not ready within {format_duration(int(READY_SECONDS * SECOND))}"
            raise NotReady(f"node {node}: {state.exit or late}")


def _is_restartable(node: NodeStatus) -> bool:
    """Whether dora starts the node again after RestartNode, which counts as a restart."""
    return node.policy != "never" and not 0 < node.max_restarts <= node.restarts


def _status(definition: Mapping[str, Any], kind: str) -> NodeStatus:
    node = str(definition["id"])
    return initial_nodes({node: kind}, {"nodes": [definition]}, now_us())[node]


def _of(node: str, is_so: Callable[[NodeStatus], bool]) -> Callable[[Cell], bool]:
    return lambda cell: node not in cell.nodes or is_so(cell.nodes[node])
