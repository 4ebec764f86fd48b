"""A run whose nodes dora exchanges at once, for reloads of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dora_systemd.adapters.dora.preparation import Prepared, prepare
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.decisions.reload.changes import How, Step
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.pump import Pump
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.reload.apply import Applier, Run
from dora_systemd.runner.reload.sources import Change, Versions
from dora_systemd.runner.reload.swap import Swapper
from dora_systemd.values import SECOND
from tests.unit.fakes.run import Calls, FakeDora, FakeNodes, FakePipes

RUNNING = NodeStatus("running", 7, policy="on-failure")
_SPENT = RUNNING._replace(restarts=2, max_restarts=2)
_NEVER = RUNNING._replace(policy="never")
_BACKOFF = RUNNING._replace(state="restarting", pid=0)
_HELD = RUNNING._replace(state="failed", pid=0, policy=HELD)
_ADDED, _RESTARTED, _REPLACED = (
    ["RemoveNode", "AddNode"],
    ["RestartNode", "ReplaceNode"],
    ["ReplaceNode"],
)
EXCHANGES = [
    *((False, one, _ADDED) for one in (RUNNING, _SPENT, _NEVER)),
    *((False, one, _REPLACED) for one in (_BACKOFF, _HELD)),
    (True, RUNNING, _RESTARTED),
    *((True, one, _REPLACED) for one in (_SPENT, _NEVER, _BACKOFF, _HELD)),
]
"""Whether somebody reads a node, how it is, and what dora is asked in order to replace it."""


class ReloadBench:
    """Nodes a and b that run; dora does what it is asked, unless a test has it refuse."""

    def __init__(self, root: Path, state: State = State.RUNNING, **nodes: NodeStatus) -> None:
        self.root = root
        self.calls: Calls = []
        self.pipes = FakePipes(self.calls)
        self.nodes = FakeNodes(root, self.pipes, self.calls)
        self.dora = FakeDora(self.calls)
        table = {"a": RUNNING, "b": RUNNING, **nodes}
        cell = Cell(2 * SECOND, 0, table, state, run="run", ready_us=1)
        self.pump = Pump(cell, Life("uuid"), CellPaths(root), self.nodes, self.pipes)
        self.pump.connect({do: lambda: None for do in Do})
        self.run = Run(self.pump, self.nodes, self.pipes, Swapper(self.pump, self.dora))
        for name, then in (
            *((name, self.end) for name in ("RestartNode", "RemoveNode")),
            *((name, self.spawn) for name in ("ReplaceNode", "AddNode")),
            ("Reload", lambda: None),
        ):
            self.dora.then[name] = then
        self.versions = Versions()
        self.flow = root / "flow.yml"
        self.options = RunnerOptions("robot", "uuid", str(self.flow), str(root), "/bin/true")
        self.prepared = self.write("abc")

    def write(self, nodes: str, reader: str = "") -> Prepared:
        """Save a dataflow of these nodes; each has a program of its own. reader: reads node a."""
        for one in nodes:
            (self.root / f"{one}.py").touch()
        edges = {"a": ", outputs: [o]", reader: ", inputs: {i: a/o}"} if reader else {}
        lines = [f"  - {{id: {one}, path: {one}.py{edges.get(one, '')}}}\n" for one in nodes]
        self.flow.write_text("nodes:\n" + "".join(lines))
        return prepare(self.options, {})

    @property
    def node(self) -> str:
        """The one that dora was asked about last."""
        return str([call for call in self.calls if call[0] == "ask"][-1][2])

    def end(self) -> None:
        self.pump.push(life.NodeExited(1, self.node, Exit(), False))

    def spawn(self) -> None:
        self.pump.push(life.NodeSpawned(2, self.node, 8))
        self.pump.push(life.NodeReady(3, self.node))

    def crash(self) -> None:
        self.pump.push(life.NodeSpawned(2, self.node, 8))
        self.pump.push(life.NodeExited(3, self.node, exit_of(1), False))

    def applier(self, *steps: tuple[How, str], **more: Any) -> Applier:
        found = tuple(Step(how, node, f"{self.root}/{node}.py") for how, node in steps)
        change = Change(self.prepared, found, **more)
        return Applier(self.run, change, self.options, self.versions)

    @property
    def asked(self) -> list[tuple[Any, ...]]:
        return [call[1:] for call in self.calls if call[0] == "ask"]

    def states(self) -> Mapping[str, str]:
        return {name: one.state for name, one in self.pump.cell.nodes.items()}
