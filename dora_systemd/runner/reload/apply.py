"""Carries out one reload of single nodes step by step, and can undo it."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.launch import has_pipes, kinds
from dora_systemd.decisions.cell.limits import limits_of
from dora_systemd.decisions.cell.line_rates import rates_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import owes_of
from dora_systemd.decisions.cell.status import HELD
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.life.view import has_started
from dora_systemd.decisions.reload.changes import How, Step, has_readers
from dora_systemd.decisions.settings.reload import START_FIRST
from dora_systemd.runner.cell.pump import Pump
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.reload.sources import Change, Versions
from dora_systemd.runner.reload.swap import NotReady, Swapper

_GONE = ("finished", "stopped")
_BACK = {How.ADD: How.REMOVE, How.REMOVE: How.ADD}


@dataclass(frozen=True)
class Run:
    """The parts of one run of the dataflow that reloads use."""

    pump: Pump
    nodes: Nodes
    pipes: LogPipes
    swapper: Swapper
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)  # held while nodes are replaced


async def tell_started(run: Run, tell: Callable[[], None]) -> None:
    """Notify the reloader when all nodes run: from then on the run is not a trial any more."""
    if await run.pump.wait(has_started, None):
        tell()


def is_read(node: str, options: RunnerOptions, *versions: Prepared) -> bool:
    """Return whether other nodes, or the watch over owed outputs, have an input from this node.

    versions: of the dataflow; one of them is enough.
    """
    is_owing = any(one.node == node for one in owes_of(options))
    return is_owing or any(has_readers(node, one.descriptor["nodes"]) for one in versions)


class Applier:
    """Carries out `change` in `run`. done: what was done, human-readable.

    versions: of the files that the nodes run.
    """

    def __init__(
        self, run: Run, change: Change, options: RunnerOptions, versions: Versions
    ) -> None:
        self.run = run
        self._versions = versions
        self._change = change
        self._options = options
        self._begun: list[Step] = []
        self.done: list[str] = []

    def obstacle(self) -> str:
        """The reason why dora cannot change single nodes now, or ""."""
        if self.run.pump.cell.state is not State.RUNNING:
            return "not all nodes were ready"
        for step in self._change.steps:
            if reason := self._obstacle(step):
                return reason
        return ""

    def _obstacle(self, step: Step) -> str:
        old = self.run.pump.cell.nodes.get(step.node)
        if step.how is not How.ADD:
            if old is None:
                return "" if step.how is How.REMOVE else f"the node {step.node} had been removed"
            is_gone = old.state in _GONE or (old.state == "failed" and old.policy != HELD)
            return f"the node {step.node} had ended" if is_gone else ""
        node = self._change.prepared.dataflow.node(step.node)
        has_own_pipes = node is None or has_pipes(node)
        return "" if has_own_pipes else f"dora itself reads the output of the node {step.node}"

    async def apply(self) -> None:
        """Carry out all steps. Raises DoraSystemdError when dora refuses one, and NotReady."""
        for step in self._change.steps:
            if step.how is How.REMOVE and step.node not in self.run.pump.cell.nodes:
                continue
            started = time.monotonic()
            self._begun.append(step)
            # Before the node starts: a later version may or may not be the one that it reads.
            taken = Versions()
            taken.take(step.node, self._change.files.get(step.node, ()))
            with self.run.nodes.exchanging(step.node):
                await self._take(step, self._change.prepared)
            self._versions.merge(taken)
            self._tell(step, time.monotonic() - started)

    async def undo(self, before: Prepared) -> None:
        """Undo the steps taken so far. Raises DoraSystemdError."""
        for step in reversed(self._begun):
            back = Step(_BACK.get(step.how, step.how), step.node, step.file)
            try:
                with self.run.nodes.exchanging(step.node):
                    await self._take(back, before)
            except NotReady:
                continue  # it has its old definition again, which may have failed before too

    async def _take(self, step: Step, prepared: Prepared) -> None:
        swapper = self.run.swapper
        if step.how is How.REMOVE:
            await swapper.remove(step.node)
            self.run.nodes.remove(step.node)
            return
        if step.how is How.OPERATOR:
            for operator, file in self._change.operators[step.node].items():
                if file == step.file:
                    await swapper.reload_operator(step.node, operator)
            return
        definition, kind = _definition(prepared, step.node)
        if step.how is How.ADD:
            node = prepared.dataflow.node(step.node)
            assert node is not None
            self.run.nodes.add(node, rates_of(self._options), limits_of(self._options))
            await swapper.add(definition, kind)
        elif step.how is How.REWIRE:
            await swapper.rewire(definition, kind)
        else:
            old = self.run.pump.cell.nodes[step.node]
            # In the middle of an undo, nodes of both versions can run.
            is_needed = is_read(step.node, self._options, prepared, self._change.prepared)
            has_word = self._options.has("replace")
            word = self._options.of_node(step.node, "replace") if has_word else ""
            await swapper.swap(definition, kind, is_needed, word == START_FIRST)
            if old.needs:  # two launchers must not start the node
                await self.run.nodes.wait_gone(step.node, old.pid)

    def _tell(self, step: Step, seconds: float) -> None:
        file = self._relative(step.file)
        words = f"{file}, ready after {seconds:.2f}s" if step.how is not How.REMOVE else file
        self.done.append(f"the node {step.node} was {step.how.value}: {words}")
        node = None if step.how is How.REMOVE else step.node
        self.run.pipes.write_event(
            "node-reloaded",
            node,
            how=step.how.value,
            reason=words,
            file=step.file,
            **({} if node else {"removed": step.node}),
        )

    def _relative(self, path: str) -> str:
        root = self._options.working_directory
        return str(PurePath(path).relative_to(root)) if path.startswith(f"{root}/") else path


def _definition(prepared: Prepared, node: str) -> tuple[dict[str, Any], str]:
    kind = kinds(prepared.dataflow, prepared.plan)[node]
    nodes = prepared.descriptor["nodes"]
    return next(one for one in nodes if one["id"] == node), kind
