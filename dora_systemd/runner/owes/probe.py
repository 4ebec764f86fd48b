"""Keeps one probe among the nodes of a run, see decisions/owes/probe.py."""

from collections.abc import Awaitable, Callable
from typing import Any

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora.preparation import PACKAGE
from dora_systemd.decisions.cell.launch import PERL, LaunchPlan
from dora_systemd.decisions.cell.owes import PROBE, owes_of
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.owes.probe import Feeds, probe_definition
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

FindPython = Callable[[], Awaitable[str]]

_SOON, _LATE = SECOND, 32 * SECOND
"""µs between two probes; the pause doubles while none lives for _LATE."""
_DEAF = 30 * SECOND
"""µs without a beat, in which this process has run, after which the probe is replaced: a machine
under load takes seconds to start a Python."""
_ANSWER_SECONDS = 30.0
_GONE = ("finished", "stopped")
_TRIES = 2
"""Probes that end early, one after the other, before that is reported."""


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
        unit, paths = run.nodes.places
        self._run = run
        self._engine = dora
        self._plan = plan
        self._feeds = feeds
        self._find_python = find_python
        self._tick = tick
        self._path = paths.times
        self._group = unit / f"{cgroup.NODE_PREFIX}{PROBE}"
        self._count = 0
        self._added_us = 0
        self._number = 0
        self._beat = 0
        self._quiet = 0
        self._next_us = 0
        self._pause = _SOON
        self._is_told = False

    async def tend(self, beat: int, now: int) -> None:
        """Start a probe if there is none. beat, now: its last beat, and now; CLOCK_MONOTONIC µs."""
        inputs = self._inputs()
        if cgroup.is_populated(self._group):
            self._check(bool(inputs), beat, now)
        elif inputs and now >= self._next_us and self._run.pump.cell.state is State.RUNNING:
            if self._pause > _SOON << _TRIES:
                self._tell("the probe ended again and again")
            self._next_us, self._pause = now + self._pause, min(2 * self._pause, _LATE)
            self._quiet = 0
            self._added_us = now
            await self._add(inputs)

    def heard(self, beat: int) -> tuple[int, int]:
        """Return the number of the last probe, and its beat: 0 if that probe has ended.

        Messages between the end of a probe and the start of the next are not recorded.
        """
        is_own = beat > self._added_us
        if is_own:
            self._number = self._count
        return self._number, beat if is_own and cgroup.is_populated(self._group) else 0

    def _inputs(self) -> list[tuple[int, str]]:
        """Return the outputs of nodes that run or may start again, each with its slot.

        Empty if all nodes that owe something have ended.
        """
        nodes, owes = self._run.pump.cell.nodes, owes_of(self._plan.options)
        if not any(_can_come(nodes.get(one.node)) for one in owes):
            return []
        slots = enumerate(self._feeds.places)
        return [(at, one) for at, one in slots if _can_come(nodes.get(one.partition("/")[0]))]

    def _check(self, is_needed: bool, beat: int, now: int) -> None:
        """Kill a probe that hangs: the dataflow would not finish without it."""
        is_well = is_needed and beat != self._beat
        self._quiet = 0 if is_well else self._quiet + self._tick
        self._beat = beat
        if self._quiet > _DEAF:
            if is_needed:
                self._tell("the probe does not respond")
            cgroup.kill_group(self._group)
        elif is_well and now > self._next_us + _LATE:
            self._pause, self._is_told = _SOON, False

    async def _add(self, inputs: list[tuple[int, str]]) -> None:
        try:
            python = await self._find_python()
            cgroup.make_group(self._group)
            cgroup.kill_as_one(self._group)
            params = protocol.add_params(self._run.pump.cell.run, self._define(python, inputs))
            reply = await self._engine.ask_apart(params, _ANSWER_SECONDS)
            if reply.error:
                self._tell(protocol.first_line(reply.error))
        except DoraSystemdError as error:
            self._tell(error.message)
        except OSError as error:
            self._tell(f"its group: {error.strerror}")

    def _define(self, python: str, inputs: list[tuple[int, str]]) -> dict[str, Any]:
        script, seconds = PACKAGE / "runner" / "owes" / "listen.py", self._tick / SECOND / 2
        command = [python, "-u", str(script), str(self._path), f"{seconds:g}"]
        self._count += 1
        return probe_definition(self._count, command, (PERL, self._plan.launcher), inputs)

    def _tell(self, reason: str) -> None:
        """Report that the outputs are not watched, once until a probe has run for a while."""
        if not self._is_told and self._run.pump.cell.state is State.RUNNING:
            self._is_told = True
            self._run.pipes.write_event("outputs-unwatched", reason=reason)


def _can_come(node: NodeStatus | None) -> bool:
    if node is None or node.state in _GONE:
        return False
    return node.state != "failed" or node.policy == HELD
