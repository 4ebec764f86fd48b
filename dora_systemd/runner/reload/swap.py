"""Replaces single nodes of a dataflow while it runs.

dora has no request for this that is enough. RestartNode ends the old process, but counts as a
restart and starts the new process only after the node's restart delay, and dora refuses it for a
node that has no restart left. ReplaceNode starts the new process while the old one still runs: on a
busy machine dora may then deliver no message to the new one. RemoveNode closes the inputs that
other nodes have from the node, and AddNode does not open them again. So the Swapper sends

    RemoveNode, then AddNode         if nobody reads the node
    RestartNode, then ReplaceNode    if other nodes do: ReplaceNode starts the new process at once
    ReplaceNode                      if dora would not restart it, or it has no process, or by the
                                     setting the new process starts first

AddNode and ReplaceNode begin with all restarts, and wait for no delay. A node with other inputs or
outputs can only be removed and added.

The Swapper sends requests, and the pump receives their effect: exits and readiness arrive as
events of the run. So a method that waits for the new process first pushes the event that marks the
node as reloading in the live table, and only then sends the request to dora. In the other order the
old state "running" would satisfy the wait for the new process.
"""

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.status import RESTART, NodeStatus
from dora_systemd.decisions.cell.stops import within_of
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
    """The new node has failed or is not ready in time; the message states which."""


def patience(cell: Cell) -> int:
    """Return the seconds that a new version may take to be ready.

    A machine or a node that is slow needs longer, so it depends on how long `cell` took to start.
    """
    start = (cell.ready_us - cell.started_us) // SECOND
    return min(max(_READY_SECONDS, _STARTS * start), _MOST_SECONDS)


class Target(NamedTuple):
    """A node whose process has to end."""

    node: str
    status: NodeStatus  # before that
    definition: Mapping[str, Any]  # as dora gets it
    has_readers: bool  # whether anything in the dataflow reads its outputs
    grace: int  # µs that the process has to end

    @property
    def patience(self) -> int:
        """µs until dora sends SIGTERM: dora's message to stop does not reach a node that starts."""
        return 0 if self.status.state == "starting" else self.grace

    @property
    def is_removable(self) -> bool:
        """Whether dora can remove it, and add it again. It would add a node of a machine here."""
        return not self.has_readers and not self.status.machine


class Swapper:
    """Has dora change nodes of the run of `pump`, and waits for the effect."""

    def __init__(self, pump: Pump, dora: Engine) -> None:
        self._pump = pump
        self._engine = dora

    def target(self, definition: Mapping[str, Any], has_readers: bool) -> Target:
        """The node with this definition as it is now, with the time that it has to stop."""
        node, cell = str(definition["id"]), self._pump.cell
        grace = within_of(cell.stops, node, cell.grace)
        return Target(node, cell.nodes[node], definition, has_readers, grace)

    async def swap(
        self, definition: Mapping[str, Any], kind: str, has_readers: bool, starts_first: bool
    ) -> None:
        """Replace a node that keeps its inputs and outputs. Raises DoraSystemdError and NotReady.

        definition: the node as dora gets it. kind: as in the live table. starts_first: whether the
        new process starts while the old one runs.
        """
        node = str(definition["id"])
        await self._pump.wait(of_node(node, _is_known), patience(self._pump.cell))
        target = self.target(definition, has_readers)
        self._pump.push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        if starts_first or target.status.needs:  # a launcher that waits reads no messages
            await self.begin(protocol.replace_params(self._run, definition))
        else:
            await self.replace(target)
        await self._wait_ready(node)

    async def replace(self, target: Target) -> None:
        """End the process of a node, and start the next one. Raises DoraSystemdError."""
        if target.status.may_run and target.is_removable:
            await self._end("RemoveNode", target)
            await self.begin(protocol.add_params(self._run, target.definition))
        else:
            await self.hold(target)

    async def hold(self, target: Target) -> None:
        """End the process of a node that dora keeps; the next one waits if its gate is closed.

        Raises DoraSystemdError if dora has given the node up.
        """
        if target.status.may_run and is_restartable(target.status):
            # Dora refuses this for a node that is just being started.
            with contextlib.suppress(DoraSystemdError):
                await self._end("RestartNode", target)
        await self.begin(protocol.replace_params(self._run, target.definition))

    async def rewire(self, definition: Mapping[str, Any], kind: str) -> None:
        """Replace a node whose inputs or outputs change. Raises DoraSystemdError and NotReady."""
        node = str(definition["id"])
        target = self.target(definition, has_readers=False)
        self._pump.push(life.NodeReloading(now_us(), node, _status(definition, kind)))
        await self._end("RemoveNode", target)
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
        target = self.target({"id": node}, has_readers=False)
        self._pump.push(life.NodeReloading(now_us(), node))
        await self._end("RemoveNode", target)
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

    async def begin(self, params: protocol.Params) -> None:
        """Have dora start a process, unless the dataflow is stopped meanwhile."""
        if self._pump.cell.state is State.RUNNING:
            await self.ask(params)

    async def _end(self, method: str, target: Target) -> None:
        await self.ask(protocol.node_params(method, self._run, target.node, target.patience))
        over = of_node(target.node, _has_ended)
        await self._pump.wait(over, stop_timeout(target.grace) / SECOND)

    async def _wait_ready(self, node: str) -> None:
        seconds = patience(self._pump.cell)
        await self._pump.wait(of_node(node, _is_settled), seconds)
        state = self._pump.cell.nodes[node]
        if not state.is_alive and not state.needs:
            late = f"not ready within {format_duration(seconds * SECOND)}"
            raise NotReady(f"node {node}: {str(state.exit) or late}")


def _is_known(node: NodeStatus) -> bool:
    """Whether the pid is known, if there is a process: else RemoveNode would end it unnoticed."""
    return node.state != "starting" or bool(node.pid) or bool(node.machine)


def _has_ended(node: NodeStatus) -> bool:
    """Whether the process has ended that ran when dora received the request to end it.

    A requested restart can concern another machine, whose pids are not known here.
    """
    is_asked = node.asked == RESTART and node.state != "waiting"
    return node.state != "reloading" if is_asked else not node.pid


def _is_settled(node: NodeStatus) -> bool:
    return node.is_alive or node.state in ("failed", "finished", "waiting")


def is_restartable(node: NodeStatus) -> bool:
    """Whether dora would start the node again: only then RestartNode is sent, as a restart."""
    used = node.restarts + (node.state == "restarting")
    return node.policy != "never" and not 0 < node.max_restarts <= used


def _status(definition: Mapping[str, Any], kind: str) -> NodeStatus:
    node = str(definition["id"])
    return initial_nodes({node: kind}, {"nodes": [definition]}, now_us())[node]


def of_node(node: str, is_so: Callable[[NodeStatus], bool]) -> Callable[[Cell], bool]:
    """Return whether `is_so` holds for a node, or the node is gone, as a condition of the cell."""
    return lambda cell: node not in cell.nodes or is_so(cell.nodes[node])
