"""Restarts and stops single nodes, without the restarts that their policy allows.

A restart by hand replaces the process as a reload does, see runner/reload/swap.py. Nothing brings
back a node after dora's StopNode. So the Hand does otherwise:

                     nobody reads the node    others read it
    stop             RemoveNode               as a restart, and its launcher waits at a closed gate
    restart after it AddNode                  opens the gate

A node with readers is only removed if it has no launcher of ours.
"""

from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life.nodes import held, is_over_but_for_held
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.swap import Target, of_node
from dora_systemd.values import SECOND


class Hand:
    """Acts on nodes of `run`, whose lock the caller holds."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._removed: set[str] = set()
        self._left: dict[str, int] = {}

    async def replace(self, target: Target) -> None:
        """End the process of a node, and start the next one. Raises DoraSystemdError."""
        with self.run.nodes.exchanging(target.node):
            await self.run.swapper.replace(target)

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
        self._left[node] = target.status.pid
        await self.run.swapper.hold(target)

    async def _remove(self, target: Target) -> None:
        node = target.node
        self._removed.add(node)
        run, swapper = self.run.pump.cell.run, self.run.swapper
        await swapper.ask(protocol.node_params("RemoveNode", run, node, target.patience))
        if target.status.state == "waiting":
            self.run.nodes.gates.leave(node)

    async def bring_back(self, target: Target) -> None:
        """Start a node that was stopped. Raises DoraSystemdError."""
        node, gates = target.node, self.run.nodes.gates
        await self.run.nodes.wait_gone(node, self._left.pop(node, 0))
        if node in self._removed:
            seconds = stop_timeout(target.grace) / SECOND
            await self.run.pump.wait(of_node(node, lambda one: not one.pid), seconds)
            gates.reset(node)
            add = protocol.add_params(self.run.pump.cell.run, target.definition)
            await self.run.swapper.begin(add)
            self._removed.discard(node)
        elif not gates.is_for_needs(node):  # else it is opened when its needs are met
            gates.open(node)


async def end_held(run: Run) -> None:
    """Let a dataflow end when all nodes but stopped ones have ended: these could come back."""

    def is_over(cell: Cell) -> bool:
        return cell.state is State.RUNNING and is_over_but_for_held(cell.nodes)

    await run.pump.wait(is_over, None)
    for node in held(run.pump.cell.nodes):
        run.nodes.gates.leave(node)
