"""The order of a stop over several machines: the head has it, and members stop their own nodes.

Each machine sends the signals to its own nodes, and measures their time. dora reports the end of a
node to all machines, so the head needs no answer of a member. A member keeps its daemon until no
machine has a node any more: the daemon may still have messages for nodes that stop later.
"""

from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.node_table import busy_machines
from dora_systemd.decisions.life.states import NodeAction, State, StopNode
from dora_systemd.decisions.life.stop_order import most_time
from dora_systemd.decisions.machines import wire
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Tasks
from dora_systemd.runner.cell.node_stops import NodeStops
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.machines.roster import Roster
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.values import SECOND

_TRAVEL = SECOND // 2
"""µs for the last messages of a node to reach a node on another machine. dora reports the end of a
node by another way, which may be faster."""
_LOOK_SECONDS = 0.2


class SpreadStops(NodeStops):
    """The stop of the nodes of one run, on the head.

    A machine that is silent may only be slow, and a recorder there would lose what it has. So that
    machine is lost when the lease ends its connection, and no earlier.
    """

    def __init__(
        self, pump: Pump, dora: Engine, nodes: Nodes, tasks: Tasks, roster: Roster
    ) -> None:
        super().__init__(pump, dora, nodes, tasks)
        self._roster = roster

    def perform(self, action: NodeAction) -> None:
        """Carry out one action, or have the machine of the node carry it out."""
        if isinstance(action, StopNode) and self._comes_from_afar(action.node):
            self._begin()
            self._loop.call_later(_TRAVEL / SECOND, self._stop_late, action)
        elif isinstance(action, StopNode):
            self._stop_there_or_here(action)
        else:
            super().perform(action)

    def _comes_from_afar(self, node: str) -> bool:
        """Whether a node that has stopped before this one is on another machine."""
        nodes, stop = self._pump.cell.nodes, self._pump.cell.stops.get(node)
        before = [nodes[one].machine for one in stop.after if one in nodes] if stop else []
        return any(machine != nodes[node].machine for machine in before)

    def _stop_late(self, action: StopNode) -> None:
        if self._pump.cell.state is State.STOPPING:
            self._stop_there_or_here(action)

    def _stop_there_or_here(self, action: StopNode) -> None:
        machine = self._pump.cell.nodes[action.node].machine
        if not machine:
            super().perform(action)
            return
        began = self._begin()
        most = most_time(self._pump.cell, action.node, self._clock_us() - began)
        turn = wire.StopNode(action.node, action.after, max(most, action.after))
        self._roster.tell(turn, machine)

    def _begin(self) -> int:
        is_first, began = self._began_us is None, super()._begin()
        if is_first:
            self._roster.close()  # a machine that comes back takes part in the next run
            self._roster.tell(wire.Stopping(self._pump.cell.stop_by, self._pump.cell.stop_limit))
            self._tasks.spawn("watch the other machines as they stop", self._watch())
        return began

    async def _watch(self) -> None:
        """Lose machines that are gone; let the others leave when no node is left anywhere."""
        pump = self._pump
        while not await pump.wait(lambda cell: cell.state is not State.STOPPING, _LOOK_SECONDS):
            for name in busy_machines(pump.cell.nodes).intersection(self._roster.gone()):
                pump.push(life.MachineLost(now_us(), name, "it does not answer"))
        self._roster.tell(wire.Stopping(pump.cell.stop_by))
