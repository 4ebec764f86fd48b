"""A dialogue with a dora of few words, and all that comes of it."""

import asyncio
from dataclasses import replace
from pathlib import Path

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.pump import Pump
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.values import SECOND
from tests.unit.fakes.run import Calls, FakeDora, FakeNodes, FakePipes

OPTIONS = RunnerOptions("robot", "uuid", "/srv/flow.yml", "/srv", "/bin/dora")
DESCRIPTOR = {"nodes": [{"id": "a"}]}


class Heard(Pump):
    """A pump that only notes the events: each test chooses the state."""

    def push(self, event: life.Event) -> None:
        self.heard.append(event)
        self.calls.append(("push", type(event).__name__))

    def enter(self, state: State) -> None:
        self.cell = replace(self.cell, state=state)
        self._tell_waiting()

    heard: list[life.Event]
    calls: Calls


class Bench:
    """Each action can be taken; the events that come of it are in `heard`."""

    def __init__(
        self,
        root: Path,
        state: State = State.RUNNING,
        options: RunnerOptions = OPTIONS,
        kind: type[Heard] = Heard,
    ) -> None:
        self.calls: Calls = []
        self.pipes = FakePipes(self.calls)
        self.nodes = FakeNodes(root, self.pipes, self.calls)
        self.dora = FakeDora(self.calls)
        cell = Cell(2 * SECOND, 0, {"a": NodeStatus("running", 7)}, state, run="run")
        self.paths = CellPaths(root)
        self.pump = kind(cell, Life("uuid"), self.paths, self.nodes, self.pipes)
        self.pump.heard, self.pump.calls = [], self.calls
        self.dialogue = Dialogue(options, self.pump, self.dora, self.nodes, self.pipes)
        self.actions = self.dialogue.actions(DESCRIPTOR, {"ADDED": "1"})

    def enter(self, state: State) -> None:
        self.pump.enter(state)

    async def do(self, do: Do) -> list[life.Event]:
        self.actions[do]()
        await asyncio.sleep(1)
        return self.heard

    @property
    def heard(self) -> list[life.Event]:
        """What was heard so far, without its times."""
        return [replace(one, at_us=0) for one in self.pump.heard]
