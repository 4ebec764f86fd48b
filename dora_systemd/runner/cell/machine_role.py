"""What is different in a cell if its dataflow has several machines.

Alone is the cell of all others. The head and the members are in runner/machines/.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.dora.engine import Child
from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.runner_socket.listener import Session
from dora_systemd.decisions.cell.launch import kinds
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.stops import named_stops
from dora_systemd.decisions.descriptor.dataflow import Dataflow, downstream_of
from dora_systemd.decisions.life.events import NodeAsked
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.life.view import initial_nodes
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.pump import Pump
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.nodes.nodes import Nodes

if TYPE_CHECKING:
    from dora_systemd.adapters.dora.check import DoraCheck
    from dora_systemd.adapters.runner_socket.door import Door
    from dora_systemd.runner.cell.node_stops import NodeStops


def first_cell(options: RunnerOptions, prepared: Prepared, started_us: int) -> Cell:
    """The cell of a run before its first event. started_us: CLOCK_REALTIME."""
    nodes = kinds(prepared.dataflow, prepared.plan)
    stops = named_stops(options.by_node("stop"))
    return Cell(
        *(options.grace, started_us, initial_nodes(nodes, prepared.descriptor, started_us)),
        downstream=downstream_of(prepared.dataflow),
        is_attached=options.attached,
        stops=stops,
        stop_limit=options.of_dataflow("stop_limit") if stops or options.machine else 0,
    )


class Alone:
    """The role of a machine that runs all nodes of the dataflow.

    options: of the runner. find_own_refusal: the error with which this machine would refuse to
    start again.
    """

    def __init__(self, options: RunnerOptions, this_life: Life) -> None:
        self.options, self.this_life = options, this_life
        self.find_own_refusal: Callable[[], DoraSystemdError | None] = lambda: None

    @property
    def sessions(self) -> Mapping[str, Session]:
        """The sessions of the runner's socket by verb; all other requests get a single answer."""
        return {}

    @property
    def door(self) -> "Door | None":
        """The Door that has listened at the runner's socket since its start, if there is one."""
        return None

    @property
    def start_timeout(self) -> int:
        """µs from the beginning of a run to StartTimedOut."""
        return self.options.start_timeout

    def own(self, options: RunnerOptions) -> RunnerOptions:
        """Return the options for the nodes of this machine."""
        return options

    def here(self, dataflow: Dataflow) -> Dataflow:
        """Return the dataflow with only the nodes of this machine."""
        return dataflow

    def check(self, dataflow: Dataflow) -> None:
        """Raise DoraSystemdError for a dataflow that this machine would refuse at a start."""

    async def find_refusal(self) -> DoraSystemdError | None:
        """Return the error with which another machine would refuse a new start, or None."""
        return None

    def prepare(self, paths: CellPaths, prepared: Prepared, check: "DoraCheck") -> None:
        """Prepare the run of the dataflow, which has been read. Raises DoraSystemdError."""

    def begin_again(self, last: Cell) -> None:
        """Prepare another run in this process. last: the last cell of the run before."""

    def engine(
        self, dora: str, paths: CellPaths, environment: Mapping[str, str], boot: EarlyDaemon | None
    ) -> Engine:
        return Engine(dora, paths, environment, boot)

    def start_coordinator(self, dora: Engine) -> Child | None:
        """Start the coordinator, if it runs on this machine. Raises OSError."""
        return dora.start_coordinator()

    def definition(self, node: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the definition of a node that dora gets while the run lasts."""
        return node

    async def tell_asked(self, machine: str, event: NodeAsked) -> None:
        """Notify the node's machine of a requested restart or stop, before that is carried out."""

    def tell_refused(self, machine: str, node: str, reason: str) -> None:
        """Notify the node's machine that dora has refused the requested restart or stop."""

    def cell(self, cell: Cell) -> Cell:
        """Return the cell at the beginning of a run."""
        return cell

    def dialogue(
        self, options: RunnerOptions, pump: Pump, dora: Engine, nodes: Nodes, pipes: LogPipes
    ) -> Dialogue:
        """Return the Dialogue that carries out the actions of the run."""
        return Dialogue(options, pump, dora, nodes, pipes)

    def node_stops(self, pump: Pump, dora: Engine, nodes: Nodes, dialogue: Dialogue) -> "NodeStops":
        """Return what carries out a stop that has an order."""
        # Imported late: few dataflows have one.
        from dora_systemd.runner.cell.node_stops import NodeStops

        return NodeStops(pump, dora, nodes, dialogue)
