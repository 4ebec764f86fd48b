"""Waits for what nodes need: tasks of a run, only if a node has needs.

A thread checks the paths, because a file system may hang. The thread checks them when a parent
directory of a path or a network interface changes, and every _LOOK_SECONDS: not all file systems
report changes or mounts, nor do all CAN drivers. For devices in /dev, of which the kernel reports
all, the thread rests until a change. The decisions are in decisions/needs/steps.py, the gates in
runner/nodes/launcher_gates.py.
"""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping
from typing import Any

from dora_systemd.adapters.host import notify
from dora_systemd.adapters.host.inotify import Inotify
from dora_systemd.adapters.host.presence import (
    LinkChanges,
    Presence,
    are_devices,
    look_at,
    look_at_link,
    watched_places,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import LATCHED, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.needs.steps import Do, NeedStep, need_steps
from dora_systemd.decisions.needs.words import NET
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import INFINITY, SECOND


class Watch:
    """Directories that are watched by inotify(7), and network interfaces. Close it.

    Where the kernel has no inotify instance left, or the sandbox no AF_NETLINK, wait() waits for
    its whole time.
    """

    def __init__(self, has_links: bool = False) -> None:
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        self._inotify: Inotify | None = None
        self._sources: list[Inotify | LinkChanges] = []
        with contextlib.suppress(OSError):
            self._inotify = Inotify()
            self._add(self._inotify)
        if has_links:
            with contextlib.suppress(OSError):
                self._add(LinkChanges())

    def _add(self, source: Inotify | LinkChanges) -> None:
        self._sources.append(source)
        self._loop.add_reader(source.fd, self._read, source)

    def _read(self, source: Inotify | LinkChanges) -> None:
        source.drain()
        self._event.set()

    def set_places(self, directories: Iterable[str]) -> set[str]:
        """Watch these directories instead of those before; return those that are watched.

        A thread may call this.
        """
        return set() if self._inotify is None else self._inotify.watch(directories)

    def clear(self) -> None:
        """Forget the changes so far."""
        self._event.clear()

    def wake(self) -> None:
        """Make the task check again."""
        self._event.set()

    async def wait(self, seconds: float | None) -> None:
        """Wait for a change, at most `seconds`, None for any time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._event.wait()

    def close(self) -> None:
        for source in self._sources:
            self._loop.remove_reader(source.fd)
            source.close()
        self._sources, self._inotify = [], None


def check(what: str) -> Presence:
    """Check what a node needs: a path, or net:INTERFACE."""
    return look_at_link(what.removeprefix(NET)) if what.startswith(NET) else look_at(what)


_LOOK_SECONDS = 2.0
_PAUSE_SECONDS = 0.05
"""Shortest time between two checks: a directory such as /tmp may change all the time."""
_AGAIN = "plugged in again"
_FAILED = ("failed", "restarting")
_STATES = (State.WAITING, State.RUNNING)

Spawn = Callable[[str, Coroutine[Any, Any, None]], None]
Definition = Callable[[str], Mapping[str, Any]]


def wait_for_needs(run: Run, options: RunnerOptions, definition: Definition, spawn: Spawn) -> None:
    """Begin to check for what nodes need, whose gates are closed.

    definition: a node as dora gets it. spawn: begins a task of the run.
    """
    needs = Needs(run, options, definition, spawn)
    spawn("wait for what nodes need", needs.work())
    spawn("see whether failed nodes lack something", needs.follow())
    spawn("see what becomes of the nodes with needs", needs.see_changes())


class Needs:
    """The nodes with needs of one run. Call work() once."""

    def __init__(
        self, run: Run, options: RunnerOptions, definition: Definition, spawn: Spawn
    ) -> None:
        self._run, self._definition, self._spawn = run, definition, spawn
        self._needs = options.by_node("needs")
        self._start_timeout = options.start_timeout
        self._passed: dict[str, list[Presence]] = {}
        self._losing: set[str] = set()
        self._closed: set[str] = set()
        self._down: set[tuple[str, int]] = set()

        every = {one for needs in self._needs.values() for one in needs}
        self._paths = {one for one in every if not one.startswith(NET)}
        self._has_links = every != self._paths
        self._watch = Watch(self._has_links)
        self._are_seen = False  # whether each change of the paths wakes the task
        self._is_undone = False  # whether a step has to be taken later
        self._seen = self._states(run.pump.cell)

    async def follow(self) -> None:
        """Check the needs again when a node has failed: dora would use up its restarts.

        The gate of a node without restarts is closed until it is clear why it has failed.
        """
        pump = self._run.pump
        while await pump.wait(lambda cell: self._failed(cell) != self._down, None):
            self._down = self._failed(pump.cell)
            for node, _ in self._down:
                one = pump.cell.nodes[node]
                if one.policy == LATCHED and one.state == "failed" and node not in self._closed:
                    self._run.nodes.gates.close(node)
                    self._closed.add(node)
            self._watch.wake()

    async def see_changes(self) -> None:
        """Check the needs again when the state of a node changes."""
        pump = self._run.pump
        while await pump.wait(lambda cell: self._states(cell) != self._seen, None):
            self._seen = self._states(pump.cell)
            self._watch.wake()

    def _states(self, cell: Cell) -> tuple[State, list[NodeStatus | None]]:
        return cell.state, [*map(cell.nodes.get, self._needs)]

    def _failed(self, cell: Cell) -> set[tuple[str, int]]:
        """The nodes that have failed, and since when."""
        nodes = ((node, cell.nodes[node]) for node in self._needs.keys() & cell.nodes.keys())
        return {(node, one.since_us) for node, one in nodes if one.state in _FAILED}

    async def work(self) -> None:
        """Check the needs, and act, until the run ends."""
        with contextlib.closing(self._watch):
            while await self._run.pump.wait(lambda cell: cell.state in _STATES, None):
                self._watch.clear()
                self._act(await asyncio.to_thread(self._look))
                may_rest = self._are_seen and not self._is_undone
                await self._watch.wait(None if may_rest else _LOOK_SECONDS)
                await asyncio.sleep(_PAUSE_SECONDS)

    def _look(self) -> dict[str, list[Presence]]:
        # Watch first: what changes after the look is not missed then.
        places = watched_places(self._paths)
        is_complete = self._watch.set_places(places) == places
        is_local = are_devices(self._paths, places) and not self._has_links
        self._are_seen = is_complete and is_local
        return {node: [*map(check, needs)] for node, needs in self._needs.items()}

    def _act(self, found: Mapping[str, list[Presence]]) -> None:
        cell = self._run.pump.cell
        if cell.state not in _STATES:
            return
        missing = {node: self._missing(node, seen) for node, seen in found.items()}
        is_running = cell.state is State.RUNNING
        # A requested stop of a node closes its gate, too.
        passed = frozenset(one for one in self._passed if self._is_through(one))
        self._is_undone = False
        for step in list(need_steps(cell.nodes, missing, is_running, passed)):
            if step.node not in self._losing and not self._run.lock.locked():
                self._take(step, found[step.node])
            else:
                self._is_undone = True

    def _is_through(self, node: str) -> bool:
        return node in self._closed or self._run.nodes.gates.is_passing(node)

    def _missing(self, node: str, seen: list[Presence]) -> str:
        pairs = zip(self._needs[node], seen, strict=True)
        reasons = [f"{what} ({one.reason})" for what, one in pairs if one.reason]
        before = self._passed.get(node, seen)
        if not reasons and before != seen:
            changed = zip(self._needs[node], seen, before, strict=True)
            reasons = [f"{what} ({_AGAIN})" for what, one, old in changed if one != old]
        return ", ".join(reasons)

    def _take(self, step: NeedStep, seen: list[Presence]) -> None:
        node, pump, gates = step.node, self._run.pump, self._run.nodes.gates
        if step.do is Do.LET_GO:
            self._passed[node] = seen
            self._closed.discard(node)
            gates.open(node)
            pump.push(life.NodeMet(now_us(), node))
            self._renew_start()
        elif step.do is Do.HOLD:
            pump.push(life.NodeLacks(now_us(), node, step.needs))
        elif step.do is Do.GIVE_UP:
            gates.end(node, pump.cell.nodes[node].exit)
        else:
            self._lose(node, step.needs)

    def _lose(self, node: str, needs: str) -> None:
        old = self._run.pump.cell.nodes[node].pid
        self._passed.pop(node, None)
        self._losing.add(node)
        self._run.nodes.gates.close(node)
        self._run.pump.push(life.NodeLacks(now_us(), node, needs))
        self._spawn(f"make node {node} wait", self._replace(node, old))

    async def _replace(self, node: str, old: int) -> None:
        """End the process `old` of the node, and have the next one wait."""
        with self._until_done(node):
            async with self._run.lock:
                if node not in self._run.pump.cell.nodes:
                    return  # a reload has removed it
                with self._run.nodes.exchanging(node):
                    await self._hold(node)
                await self._run.nodes.wait_gone(node, old)

    async def _hold(self, node: str) -> None:
        swapper = self._run.swapper
        await swapper.hold(swapper.target(self._definition(node), has_readers=True))

    @contextlib.contextmanager
    def _until_done(self, node: str) -> Iterator[None]:
        try:
            yield
        except DoraSystemdError as error:
            if self._run.pump.cell.state is State.RUNNING:
                reason = f"node {node} cannot wait for what it needs: {error.message}"
                self._run.pump.push(life.Refused(now_us(), reason))
        finally:
            self._losing.discard(node)
            self._watch.wake()

    def _renew_start(self) -> None:
        """Begin the start timeout again, which excludes the time of waiting."""
        if self._run.pump.cell.state is not State.WAITING or self._start_timeout == INFINITY:
            return
        notify.extend_timeout(2 * self._start_timeout)
        late = life.StartTimedOut(now_us(), self._start_timeout)
        loop = asyncio.get_running_loop()
        loop.call_later(self._start_timeout / SECOND, self._run.pump.push, late)
