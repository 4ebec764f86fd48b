"""Restarts and stops single nodes, without the restarts that their policy allows.

dora counts a RestartNode as a restart, waits for the delay of the node, and ends the node for good
if its restarts are used up; nothing brings back a node after StopNode. So the Hand does otherwise:

              nobody reads the node          others read it
    restart   RemoveNode, then AddNode       RestartNode to end it, then ReplaceNode
    stop      RemoveNode                     the same, and its launcher waits at a closed gate
    restart   AddNode                        opens the gate
    after it

AddNode and ReplaceNode begin with all restarts, and wait for no delay. Nodes that read a removed
one see a closed input, and hear nothing of the node that is added in its place. So a node with
readers is only removed if it has no launcher of ours. dora lets a node without a restart policy end
only while its replacement starts, see protocol.OVERLAP.
"""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from dora_systemd.decisions.cell.asked import is_stopped
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life.nodes import held, is_over_but_for_held
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.swap import is_restartable
from dora_systemd.values import SECOND


@dataclass(frozen=True)
class Target:
    """A node that something is asked of. status: before that. definition: as dora gets it.

    grace: µs that its process has to end.
    """

    node: str
    status: NodeStatus
    definition: Mapping[str, Any]
    has_readers: bool
    grace: int

    @property
    def patience(self) -> int:
        """µs until dora sends SIGTERM: dora's message to stop does not reach a node that starts."""
        return 0 if self.status.state == "starting" else self.grace

    @property
    def has_process(self) -> bool:
        """Whether its program may run. The head of several machines knows no pid of others."""
        return self.status.state in ("starting", "ready", "running", "reloading")


class Hand:
    """Acts on nodes of `run`, whose lock the caller holds."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._removed: set[str] = set()
        self._left: dict[str, int] = {}

    async def replace(self, target: Target) -> None:
        """End the process of a node, and start the next one. Raises DoraSystemdError."""
        with self.run.nodes.exchanging(target.node):
            # dora would add the node of another machine here.
            is_lone = not target.has_readers and not target.status.machine
            if target.has_process and is_lone:
                await self._end("RemoveNode", target)
                await self._begin(protocol.add_params(self._run, target.definition))
                return
            await self._end_restartable(target)
            await self._begin(protocol.replace_params(self._run, target.definition))

    async def stop(self, target: Target) -> None:
        """End a node, so that bring_back() can start it again. Raises DoraSystemdError."""
        with self.run.nodes.exchanging(target.node):
            if self._can_hold(target):
                await self._hold(target)
            else:
                await self._remove(target)

    def _can_hold(self, target: Target) -> bool:
        is_here = not target.status.machine
        is_running = self.run.pump.cell.state is State.RUNNING  # else dora waits for the launcher
        return (
            target.has_readers
            and is_here
            and is_running
            and self.run.nodes.has_gate_for(target.node)
        )

    async def _hold(self, target: Target) -> None:
        node, gates = target.node, self.run.nodes.gates
        gates.add(node)
        gates.close(node)
        if target.status.state == "waiting":
            return  # its launcher is at the gate
        await self._end_restartable(target)
        self._left[node] = target.status.pid
        await self._begin(protocol.replace_params(self._run, target.definition))

    async def _remove(self, target: Target) -> None:
        node = target.node
        self._removed.add(node)
        await self._ask(protocol.node_params("RemoveNode", self._run, node, target.patience))
        if target.status.state == "waiting":
            self.run.nodes.gates.leave(node)

    async def bring_back(self, target: Target) -> None:
        """Start a node that was stopped. Raises DoraSystemdError."""
        node, gates = target.node, self.run.nodes.gates
        await self.run.nodes.wait_gone(node, self._left.pop(node, 0))
        if node in self._removed:
            await self._wait(node, lambda one: not one.pid, target.grace)
            gates.reset(node)
            await self._begin(protocol.add_params(self._run, target.definition))
            self._removed.discard(node)
        elif not gates.is_for_needs(node):  # else it is opened when its needs are met
            gates.open(node)

    async def _end_restartable(self, target: Target) -> None:
        """End the process if dora can start it again; else its replacement ends it."""
        if target.has_process and is_restartable(target.status):
            # Dora refuses this for a node that is just being started.
            with contextlib.suppress(DoraSystemdError):
                await self._end("RestartNode", target)

    async def _end(self, method: str, target: Target) -> None:
        await self._ask(protocol.node_params(method, self._run, target.node, target.patience))
        await self._wait(target.node, _has_ended, target.grace)

    async def _wait(self, node: str, is_so: Callable[[NodeStatus], bool], grace: int) -> None:
        def is_over(cell: Cell) -> bool:
            return node not in cell.nodes or is_so(cell.nodes[node])

        await self.run.pump.wait(is_over, stop_timeout(grace) / SECOND)

    async def _begin(self, params: protocol.Params) -> None:
        """Start a process, unless a stop of the dataflow has come meanwhile."""
        if self.run.pump.cell.state is State.RUNNING:
            await self._ask(params)

    @property
    def _run(self) -> str:
        return self.run.pump.cell.run

    async def _ask(self, params: protocol.Params) -> None:
        await self.run.swapper.ask(params)


def _has_ended(node: NodeStatus) -> bool:
    """Whether the process that ran when somebody asked has ended."""
    return not node.pid if is_stopped(node) else node.state != "reloading"


async def end_held(run: Run) -> None:
    """Let a dataflow end when all nodes but stopped ones have ended: these could come back."""

    def is_over(cell: Cell) -> bool:
        return cell.state is State.RUNNING and is_over_but_for_held(cell.nodes)

    await run.pump.wait(is_over, None)
    for node in held(run.pump.cell.nodes):
        run.nodes.gates.leave(node)
