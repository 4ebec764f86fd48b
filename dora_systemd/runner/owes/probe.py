"""Keeps one probe among the nodes of a run, see decisions/owes/probe.py."""

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from dora_systemd.adapters.dora.preparation import PACKAGE
from dora_systemd.decisions.cell.launch import PERL, LaunchPlan
from dora_systemd.decisions.cell.owes import PROBE, owes_of
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.owes.probe import Feeds, probe_definition
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.owes.extra_node import ExtraNode, can_come
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

FindPython = Callable[[], Awaitable[str]]

_DEAF = 30 * SECOND
"""µs without a beat, in which this process has run, after which the probe is replaced: a machine
under load takes seconds to start a Python."""


class Probe:
    """The probe of one run. plan: of the dataflow. feeds: the outputs that the probe receives.

    tick: µs between two calls of tend(). find_python: the interpreter with dora-rs; raises
    DoraSystemdError if there is none.
    """

    def __init__(
        self,
        run: Run,
        dora: Engine,
        plan: LaunchPlan,
        feeds: Feeds,
        tick: int,
        find_python: FindPython,
    ) -> None:
        self._run = run
        self._node = ExtraNode(run, dora, PROBE)
        self._plan = plan
        self._feeds = feeds
        self._find_python = find_python
        self._tick = tick
        self._path = run.nodes.places[1].times
        self._added_us = 0
        self._number = 0
        self._beat = 0
        self._quiet = 0
        self._is_told = False

    async def tend(self, beat: int, now: int) -> None:
        """Start a probe if there is none. beat, now: its last beat, and now; CLOCK_MONOTONIC µs."""
        inputs = self._inputs()
        if self._node.is_there:
            self._check(bool(inputs), beat, now)
        elif inputs and self._node.is_due(now):
            if self._node.ends_early:
                self._tell("the probe ended again and again")
            self._quiet = 0
            self._added_us = now
            if reason := await self._node.add(now, partial(self._define, inputs)):
                self._tell(reason)

    def heard(self, beat: int) -> tuple[int, int]:
        """Return the number of the last probe, and its beat: 0 if that probe has ended.

        Messages between the end of a probe and the start of the next are not recorded.
        """
        is_own = beat > self._added_us
        if is_own:
            self._number = self._node.count
        return self._number, beat if is_own and self._node.is_there else 0

    def _inputs(self) -> list[tuple[int, str]]:
        """Return the outputs of nodes that run or may start again, each with its slot.

        Empty if all nodes that owe something have ended.
        """
        nodes, owes = self._run.pump.cell.nodes, owes_of(self._plan.options)
        if not any(can_come(nodes.get(one.node)) for one in owes):
            return []
        slots = enumerate(self._feeds.places)
        return [(at, one) for at, one in slots if can_come(nodes.get(one.partition("/")[0]))]

    def _check(self, is_needed: bool, beat: int, now: int) -> None:
        """Kill a probe that hangs: the dataflow would not finish without it."""
        is_well = is_needed and beat != self._beat
        self._quiet = 0 if is_well else self._quiet + self._tick
        self._beat = beat
        if self._quiet > _DEAF:
            if is_needed:
                self._tell("the probe does not respond")
            self._node.kill()
        elif is_well and self._node.rest(now):
            self._is_told = False

    async def _define(self, inputs: list[tuple[int, str]]) -> dict[str, Any]:
        python = await self._find_python()
        script, seconds = PACKAGE / "runner" / "owes" / "listen.py", self._tick / SECOND / 2
        command = [python, "-u", str(script), str(self._path), f"{seconds:g}"]
        self._node.count += 1
        return probe_definition(self._node.count, command, (PERL, self._plan.launcher), inputs)

    def _tell(self, reason: str) -> None:
        """Report that the outputs are not watched, once until a probe has run for a while."""
        if not self._is_told and self._run.pump.cell.state is State.RUNNING:
            self._is_told = True
            self._run.pipes.write_event("outputs-unwatched", reason=reason)
