"""Watches expected outputs: reads when each last arrived, has the judge decide, and acts.

dora restarts a node for a missing output, by RestartNode, within the restarts of the node's policy.
"""

import asyncio
import mmap
import os
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.adapters.dora.probe import probe_python
from dora_systemd.decisions.cell.owes import RESTART, WARN, owes_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.owes.judge import Judge, Look, Verdict, look
from dora_systemd.decisions.owes.probe import find_feeds, parse_times, size_of_times
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Tasks
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.owes.probe import FindPython, Probe
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

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
        """Close the file of times."""
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
        """Read the content of the file."""
        return self._map[:]

    def close(self) -> None:
        """Unmap the file, which stays for readers by its path."""
        self._map.close()
