"""The runner's side of the nodes: their cgroups, pipes and dora's log files of them."""

import asyncio
import contextlib
import resource
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.limits import limit_groups
from dora_systemd.adapters.host.process import beside
from dora_systemd.adapters.host.rights import lower_rights
from dora_systemd.adapters.logs.jsonl import JsonlTail
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.launch import has_launcher, has_pipes, is_launched
from dora_systemd.decisions.cell.limits import NodeLimits, without_cpus
from dora_systemd.decisions.cell.line_rates import RateLimits, rate_of
from dora_systemd.decisions.cell.log_backlog import marks_of
from dora_systemd.decisions.cell.rights import NodeRights
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.decisions.resources.oom import Oom
from dora_systemd.decisions.resources.usage import WHOLE_CELL, CpuSample
from dora_systemd.decisions.watchdog.watchdogs import NO_WATCHDOGS, Watchdogs
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.groups import Hold, Resources
from dora_systemd.runner.nodes.launcher_gates import Gates

if TYPE_CHECKING:
    from dora_systemd.decisions.watchdog.messages import Sign
    from dora_systemd.runner.nodes.log_changes import LogChanges
    from dora_systemd.runner.nodes.watchdog import NotifySockets

_GONE_SECONDS = 0.05


class Nodes:
    """The node groups below `unit`, the cgroup directory of the unit, and the nodes' pipes.

    stop_dues: CLOCK_MONOTONIC µs at which nodes that stop get the next signal, by node.
    """

    def __init__(
        self, unit: Path, paths: CellPaths, pipes: LogPipes, watchdogs: Watchdogs = NO_WATCHDOGS
    ) -> None:
        self._unit = unit
        self._paths = paths
        self._pipes = pipes
        self._piped: set[str] = set()
        self._launched: set[str] = set()
        self._bare: set[str] = set()
        self._limited: set[str] = set()
        self._tails: dict[str, JsonlTail | None] = {}
        self._log_changes: LogChanges | None = None
        self._holds: dict[str, Hold] = {}
        self.resources = Resources(unit)
        self.notify_sockets = _notify_sockets(watchdogs, unit, paths, pipes) if watchdogs else None
        self.gates = Gates(paths)
        self.stop_dues: dict[str, int] = {}

    def prepare(self, dataflow: Dataflow, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        """Create a group for every node, with its limits, and pipes for the nodes that use them.

        Removes groups and pipes of nodes that are no longer in the dataflow. rates: limits on the
        lines of each node. Raises OSError, and DoraSystemdError for a limit that does not take
        effect.
        """
        cgroup.enable_controllers(self._unit)
        piped = {node.id for node in dataflow.nodes if has_pipes(node)}
        gone = {*cgroup.node_groups(self._unit)} - {node.id for node in dataflow.nodes}
        for ident in gone | (self._piped - piped):
            self.remove(ident)
        self._launched.clear()
        self._bare.clear()
        for node in dataflow.nodes:
            self._make(node, rates)
        # Later runs keep what doractl set has changed since the first one.
        self._limit_first(one for one in limits if one.node not in self._limited)
        self._limited |= {node.id for node in dataflow.nodes}

    def _limit_first(self, limits: Iterable[NodeLimits]) -> None:
        """Set the limits of nodes that have not started, but not CPUs that launchers bind to."""
        has_cpuset = cgroup.CPUSET in cgroup.read_controllers(self._unit)
        self.limit(limits if has_cpuset else map(without_cpus, limits))

    def _make(self, node: Node, rates: RateLimits) -> None:
        cgroup.make_group(self._group(node.id))
        self._pipes.limit(node.id, rate_of(rates, node.id))
        cgroup.kill_as_one(self._group(node.id))
        if is_launched(node):
            self._launched.add(node.id)
            if self.notify_sockets:
                self.notify_sockets.make(node.id)
        if not has_launcher(node):
            self._bare.add(node.id)
        if has_pipes(node):
            self._pipes.make(node.id, self._paths)
            self._piped.add(node.id)
        elif node.kind is not NodeKind.DYNAMIC:
            self._tails[node.id] = None
            self._holds[node.id] = Hold(self._group(node.id), marks_of(node.raw))

    def add(self, node: Node, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        """Prepare one node that is added to a running dataflow. Raises as prepare() does.

        A node without pipes existed before, and dora continues its log file.
        """
        tail = self._tails.get(node.id)
        self._make(node, rates)
        self._limit_first(one for one in limits if one.node == node.id)
        if tail is not None:
            self._tails[node.id] = tail
        elif node.id in self._piped:
            self._pipes.open(node.id)

    def limit_lines(self, rates: RateLimits) -> None:
        """Change the limits on the lines of running nodes."""
        for node in (*self._piped, *self._tails):
            self._pipes.limit(node, rate_of(rates, node))

    def limit(self, limits: Iterable[NodeLimits]) -> None:
        """Change limits of nodes, all or none. Raises DoraSystemdError if one takes no effect."""
        limit_groups((self._group(one.node), one) for one in limits)

    def remove(self, node: str) -> None:
        """Remove the group and pipes of a node that will not start again. Raises OSError."""
        if hold := self._holds.pop(node, None):
            hold.end()
        cgroup.kill_group(self._group(node))
        if self.notify_sockets:
            self.notify_sockets.remove(node)
        if node in self._piped:
            self._pipes.forget(node)
        self._piped.discard(node)
        self._launched.discard(node)
        self._bare.discard(node)
        self._limited.discard(node)
        with contextlib.suppress(OSError):  # a dying process keeps the group for a moment
            cgroup.remove_group(self._group(node))

    def _group(self, node: str) -> Path:
        return self._unit / f"{cgroup.NODE_PREFIX}{node}"

    @property
    def places(self) -> tuple[Path, CellPaths]:
        """The cgroup directory of the unit, and the files of the cell."""
        return self._unit, self._paths

    def is_held(self, node: str) -> bool:
        """Whether the node is frozen because the journal is behind."""
        return node in self._holds and self._holds[node].is_held

    def expect(self) -> None:
        """Prepare for the launchers, which move themselves into their groups.

        The kernel makes the first move in a while wait for some 10 ms. A move that changes nothing
        waits for that now, in a thread.
        """
        beside(partial(cgroup.move_process, self._unit / cgroup.SUPERVISOR, 0))

    def listen(self, run: str) -> None:
        """Start reading the output of the nodes of `run`, for which their launchers wait."""
        raise_file_limit()
        for node in self._piped:
            self._pipes.open(node)
        directory = self._paths.work / "out" / run
        if self._tails:
            # Imported late: most nodes have pipes.
            from dora_systemd.runner.nodes.log_changes import LogChanges

            self._log_changes = LogChanges(directory, self._wake_tails)
        loop = asyncio.get_running_loop()
        for node in self._tails:
            path = directory / f"log_{node}.jsonl"
            put = partial(self._pipes.write_fields, node=node)
            is_busy = partial(self._pipes.is_busy, node)
            place, watch = self._paths.node_place(node), partial(self._watch_backlog, node)
            tail = JsonlTail(loop, path, put, is_busy, place, watch)
            if self._log_changes:
                tail.on_quiet = self._log_changes.watch
            self._tails[node] = tail
            tail.start()

    def _wake_tails(self) -> None:
        for tail in filter(None, self._tails.values()):
            tail.wake()

    def _watch_backlog(self, node: str, backlog: int) -> None:
        # The node may have been removed and added again: then this is a new Hold.
        if hold := self._holds.get(node):
            hold.look(backlog)

    def adopt(self, node: str, pid: int, rights: Sequence[NodeRights] = ()) -> None:
        """Name the lines of `node`, which dora has executed, and move it unless its launcher has.

        rights: of the nodes that have some.
        """
        self._pipes.set_pid(node, pid)
        self.gates.refill(node)
        if node not in self._launched:
            for process in _with_descendants(pid):
                with contextlib.suppress(OSError):  # the process may have exited already
                    cgroup.move_process(self._group(node), process)
                if rights and node in self._bare:
                    lower_rights(process, node, rights)

    def find_own(self, node: str, pid: int) -> list[int]:
        """Find the processes of the node, `pid` first; none if its next process has started."""
        own = sorted(cgroup.pids(self._group(node)), key=lambda one: one != pid)
        # The launcher of the next one notes its pid before it enters the group.
        return own if self.noted_pid(node) == pid else []

    def clear(self, node: str, pid: int) -> None:
        """Kill the process `pid` of the node or what that has left, and not its next process.

        Remaining processes would count against the limits of the next one, and may hold its
        resources. The launcher of the next one notes its pid before it enters the group.
        """
        if node not in self._launched:
            return
        with contextlib.suppress(OSError):
            cgroup.kill_left(self._group(node), lambda: self.noted_pid(node) == pid)

    def has_gate_for(self, node: str) -> bool:
        """Whether the launcher of the node can wait at a gate."""
        return node in self._launched

    def noted_pid(self, node: str) -> int:
        """Read the pid that the launcher of the node has written, 0 if there is none yet."""
        with contextlib.suppress(OSError, ValueError):
            return int(self._paths.node_pid(node).read_text())
        return 0

    def let_go(self) -> None:
        """Stop freezing the nodes, because they are about to end."""
        for hold in self._holds.values():
            hold.end()

    def exchanging(self, node: str) -> AbstractContextManager[None]:
        """Keep `node` thawed in the context, because dora is going to end it."""
        hold = self._holds.get(node)
        return nullcontext() if hold is None else hold.paused()

    def forget(self, node: str) -> None:
        """Discard the state of the node's ended process, before its next process starts."""
        self._pipes.set_pid(node, 0)
        if self.notify_sockets:
            self.notify_sockets.forget(node)

    def signs(self) -> dict[str, "Sign"]:
        """Return the last messages of nodes to their notify sockets."""
        return self.notify_sockets.table() if self.notify_sockets else {}

    def is_blocked(self, node: str) -> bool:
        """Whether the node may have to wait, because journald does not take its lines."""
        hold = self._holds.get(node)
        return self._pipes.is_busy(node) or (hold is not None and hold.is_held)

    def has_process(self, node: str, pid: int) -> bool:
        """Whether `pid` is a live process of the node. Zombies do not count.

        A new process is in the daemon's group until its launcher moves it: so that one is first.
        """
        return any(
            pid in cgroup.pids(one) for one in (self._unit / cgroup.SUPERVISOR, self._group(node))
        )

    async def wait_gone(self, node: str, pid: int) -> None:
        """Wait until the process `pid` of the node has ended, which dora has stopped."""
        while pid and self.has_process(node, pid):
            await asyncio.sleep(_GONE_SECONDS)

    def find_oom(self, node: str) -> Oom | None:
        """Find how the kernel has just killed a process of `node` because of memory, or None."""
        return self.resources.explain(self._group(node))

    def find_oom_of_dora(self) -> Oom | None:
        """Find how the kernel has just killed dora's own processes because of memory, or None."""
        return self.resources.explain(self._unit / cgroup.SUPERVISOR)

    def kill(self) -> None:
        """Kill every node, and queue what is left in the pipes."""
        for group in cgroup.node_groups(self._unit).values():
            cgroup.kill_group(group)
        self.drain((*self._piped, *self._tails))

    def close(self) -> None:
        """Kill every node, and stop reading."""
        self.kill()
        for node, tail in self._tails.items():
            if tail is None:
                continue
            tail.close()
            self._pipes.drain(node)  # report last lines that the rate limit suppressed
            if tail.loss:
                self._pipes.write_event("lines-lost", node, count="Some", reason=tail.loss)
        self.let_go()
        self.gates.remove()
        self._holds.clear()
        self._tails.clear()
        if self._log_changes:
            self._log_changes.close()
            self._log_changes = None

    def drain(self, nodes: Iterable[str], is_live: bool = False) -> None:
        """Queue what `nodes` have written so far, before whatever is written next.

        is_live: the nodes still run, and may be in the middle of a line.
        """
        for node in nodes:
            if (tail := self._tails.get(node)) is not None:
                tail.drain()
            self._pipes.drain(node, is_live)

    async def wait_quiet(self, seconds: float) -> None:
        """Return once dora has written nothing to the nodes' log files for `seconds`."""
        tails = [tail for tail in self._tails.values() if tail is not None]
        while sum(tail.drain() for tail in tails):
            await asyncio.sleep(seconds)

    def sample(self, now_us: int) -> CpuSample:
        """Read the CPU time used so far by the cell and by each node."""
        groups = {WHOLE_CELL: self._unit, **cgroup.node_groups(self._unit)}
        use = {key: cgroup.read_cpu(path) for key, path in groups.items()}
        return CpuSample(
            now_us,
            {key: one.cpu_us for key, one in use.items()},
            {key: one.throttling for key, one in use.items() if any(one.throttling)},
        )


def _notify_sockets(
    watchdogs: Watchdogs, unit: Path, paths: CellPaths, pipes: LogPipes
) -> "NotifySockets":
    # Imported late: most nodes have no watchdog.
    from dora_systemd.runner.nodes.watchdog import NotifySockets

    return NotifySockets(watchdogs, unit, paths, pipes.write_event)


def raise_file_limit() -> None:
    """Raise this process's soft limit of open files to the hard one: it needs four for each node.

    Call this after the coordinator and the daemon have started: they should inherit the old limit,
    and the daemon raises its own.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _with_descendants(pid: int) -> list[int]:
    found = [pid]
    for known in found:
        # Each process may exit at any moment, and its whole directory disappears.
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{known}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
    return found
