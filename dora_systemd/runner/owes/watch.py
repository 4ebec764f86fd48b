"""Watches expected outputs: reads when each last arrived, has the judge decide, and acts.

One probe among the nodes of a run receives the outputs, see decisions/owes/probe.py. dora restarts
a node for a missing output, by RestartNode, within the restarts of the node's policy.
"""

import asyncio
import mmap
import os
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from dora_systemd.adapters.dora.preparation import PACKAGE, Prepared
from dora_systemd.adapters.dora.probe import probe_python
from dora_systemd.decisions.cell.extra import PROBE
from dora_systemd.decisions.cell.launch import PERL, LaunchPlan
from dora_systemd.decisions.cell.owes import RESTART, WARN, owes_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.owes.judge import Judge, Look, Verdict, look
from dora_systemd.decisions.owes.probe import (
    Feeds,
    find_feeds,
    parse_times,
    probe_definition,
    size_of_times,
)
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Tasks
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.owes.extra_node import ExtraNode, FindPython, can_come
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

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


_ANSWER_SECONDS = 30.0
_LONGEST_GRACE = SECOND
"""A node that hangs does not stop by itself, and what it owes is late already."""


async def watch_owes(run: Run, prepared: Prepared, dora: Engine, dialogue: Tasks) -> None:
    """Watch the outputs that the options of `prepared` name, from the start of all nodes on."""
    await run.pump.wait(lambda cell: cell.state is State.RUNNING, None)
    find_python = partial(asyncio.to_thread, probe_python, prepared.plan)
    try:
        watch = Watch(run, prepared, dora, dialogue, find_python)
    except OSError as error:  # such as a full file system: the nodes run, and need not end for it
        run.pipes.write_event("outputs-unwatched", reason=f"the file of times: {error.strerror}")
        return
    with closing(watch):
        await watch.work()


class Watch:
    """The watch over one run of a dataflow. find_python: see Probe."""

    def __init__(
        self, run: Run, prepared: Prepared, dora: Engine, dialogue: Tasks, find_python: FindPython
    ) -> None:
        plan = prepared.plan
        self._run = run
        self._engine = dora
        self._dialogue = dialogue
        feeds = find_feeds(owes_of(plan.options), prepared.dataflow, self._is_here)
        self._judge = Judge(owes_of(plan.options), feeds=feeds)
        size = size_of_times(len(feeds.places))
        self._times = SharedTimes(run.nodes.places[1].times, size)
        self._probe = Probe(run, dora, plan, feeds, self._judge.tick, find_python)
        self._ready: dict[str, tuple[int, int]] = {}

    async def work(self) -> None:
        """Check the outputs periodically, and keep a probe running."""
        loop = asyncio.get_running_loop()
        while True:
            # CLOCK_MONOTONIC stops while the machine is suspended, and cannot be set.
            now = int(loop.time() * SECOND)
            beat, heard = parse_times(self._times.read(), len(self._judge.feeds.places), now)
            number, fresh = self._probe.heard(beat)
            self._look(Look(now, fresh, heard, self._lives(now), number))
            await self._probe.tend(beat, now)
            await asyncio.sleep(self._judge.tick / SECOND)

    def _is_here(self, node: str) -> bool:
        return not self._run.pump.cell.nodes.get(node, NodeStatus()).machine

    def close(self) -> None:
        self._times.close()

    def _look(self, now: Look) -> None:
        self._judge, verdicts = look(self._judge, now)
        for one in verdicts:
            self._act(one)

    def _lives(self, now: int) -> dict[str, int]:
        """Return when the process of each running node became ready, CLOCK_MONOTONIC."""
        cell = self._run.pump.cell
        if cell.state is not State.RUNNING:
            return {}
        nodes = {one.node: cell.nodes.get(one.node, NodeStatus()) for one in self._judge.owes}
        # A node that the runner has frozen cannot speak.
        there = {
            node: one
            for node, one in nodes.items()
            if one.state == "running" and not one.is_ended and not self._run.nodes.is_held(node)
        }
        for node, status in there.items():
            # The difference is taken once: the other clock may be set at any moment.
            if self._ready.get(node, (-1, 0))[0] != status.since_us:
                ready = max(now - max(now_us() - status.since_us, 0), 1)
                self._ready[node] = status.since_us, ready
        return {node: self._ready[node][1] for node in there}

    def _act(self, verdict: Verdict) -> None:
        owed, words = verdict.owed, verdict.words
        left = self._judge.silent_of(owed.node)
        if not verdict.is_silent:
            speaks = life.NodeSpeaks(now_us(), owed.node, owed.output, words, left)
            self._run.pump.push(speaks)
            return
        # A restart does not help a node that gets nothing, and uses up its budget.
        then = WARN if verdict.is_starved and owed.then == RESTART else owed.then
        silent = life.NodeSilent(now_us(), owed.node, owed.output, words, then, left)
        self._run.pump.push(silent)
        if then == RESTART:
            self._dialogue.spawn(f"restart the node {owed.node}", self._restart(silent))

    async def _restart(self, silent: life.NodeSilent) -> None:
        """Have dora restart the node. If it does not, the node counts as merely silent."""
        cell = self._run.pump.cell
        old = cell.nodes.get(silent.node, NodeStatus())
        if cell.state is not State.RUNNING or old.state != "running":
            return  # it has ended meanwhile, or is being replaced
        grace = min(cell.grace, _LONGEST_GRACE)
        params = protocol.node_params("RestartNode", cell.run, silent.node, grace)
        with self._run.nodes.exchanging(silent.node):
            if error := await self._ask(params):
                reason = f"{silent.reason}; dora does not restart it: {error}"
                self._run.pump.push(replace(silent, at_us=now_us(), then=WARN, reason=reason))
                return
            await self._run.pump.wait(
                lambda cell: cell.nodes.get(silent.node, NodeStatus()).pid != old.pid,
                stop_timeout(grace) / SECOND,
            )

    async def _ask(self, params: protocol.Params) -> str:
        try:
            return (await self._engine.ask_apart(params, _ANSWER_SECONDS)).error
        except DoraSystemdError as error:
            return error.message


class SharedTimes:
    """`size` bytes in the file at `path`, all 0 at first, which two processes share by mmap(2).

    Raises OSError.
    """

    def __init__(self, path: Path, size: int) -> None:
        path.unlink(missing_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(path, flags, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, size)  # else a full file system would be SIGBUS
            self._map = mmap.mmap(descriptor, size)
        finally:
            os.close(descriptor)

    def read(self) -> bytes:
        return self._map[:]

    def close(self) -> None:
        """Unmap the file, which stays for readers by its path."""
        self._map.close()
