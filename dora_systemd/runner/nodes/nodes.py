"""The runner's side of the nodes: their groups and their output."""

import asyncio
import contextlib
import os
import resource
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.logs.jsonl import JsonlTail
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.launch import has_pipes, is_launched
from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.decisions.cell.line_rates import RateLimits, rate_of
from dora_systemd.decisions.cell.log_backlog import marks_of
from dora_systemd.decisions.cell.status import WHOLE_CELL, CpuSample
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.decisions.resources.oom import Oom
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.hold import Hold
from dora_systemd.runner.nodes.resources import Resources


class Nodes:
    """The node groups below `unit`, the cgroup directory of the unit, and the nodes' pipes."""

    def __init__(self, unit: Path, paths: CellPaths, pipes: LogPipes) -> None:
        self._unit = unit
        self._paths = paths
        self._pipes = pipes
        self._piped: set[str] = set()
        self._launched: set[str] = set()
        self._tails: dict[str, JsonlTail | None] = {}
        self._holds: dict[str, Hold] = {}
        self.resources = Resources(unit)

    def prepare(self, dataflow: Dataflow, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        """Make a group for every node, with its limits, and pipes for those that have them.

        What there is of nodes that are no longer in the dataflow goes. rates: how many lines of
        each node are kept. Raises OSError, and DoraSystemdError for a limit that does not take
        hold.
        """
        cgroup.enable_controllers(self._unit)
        piped = {node.id for node in dataflow.nodes if has_pipes(node)}
        gone = {*cgroup.node_groups(self._unit)} - {node.id for node in dataflow.nodes}
        for ident in gone | (self._piped - piped):
            self.remove(ident)
        self._launched.clear()
        for node in dataflow.nodes:
            self._make(node, rates)
        self.limit(limits)

    def _make(self, node: Node, rates: RateLimits) -> None:
        cgroup.make_group(self._group(node.id))
        if limit := rate_of(rates, node.id):
            self._pipes.limit(node.id, limit)
        cgroup.kill_as_one(self._group(node.id))
        if is_launched(node):
            self._launched.add(node.id)
        if has_pipes(node):
            self._pipes.make(node.id, self._paths)
            self._piped.add(node.id)
        elif node.kind is not NodeKind.DYNAMIC:
            self._tails[node.id] = None
            self._holds[node.id] = Hold(self._group(node.id), marks_of(node.raw))

    def add(self, node: Node, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        """The same for one node of a dataflow that runs. Raises as prepare() does.

        One without pipes has been there before: dora's file of it goes on.
        """
        tail = self._tails.get(node.id)
        self._make(node, rates)
        self.limit(one for one in limits if one.node == node.id)
        if tail is not None:
            self._tails[node.id] = tail
        elif node.id in self._piped:
            self._pipes.open(node.id)

    def limit(self, limits: Iterable[NodeLimits]) -> None:
        """Other limits for nodes that run. Raises DoraSystemdError for one that does not hold."""
        for one in limits:
            cgroup.limit_group(self._group(one.node), one)

    def remove(self, node: str) -> None:
        """The node has ended and does not come back. Raises OSError."""
        if hold := self._holds.pop(node, None):
            hold.end()
        cgroup.kill_group(self._group(node))
        if node in self._piped:
            self._pipes.forget(node)
        self._piped.discard(node)
        self._launched.discard(node)
        with contextlib.suppress(OSError):  # what is dying holds it for a moment
            cgroup.remove_group(self._group(node))

    def _group(self, node: str) -> Path:
        return self._unit / f"{cgroup.NODE_PREFIX}{node}"

    def listen(self, run: str) -> None:
        """Begin to read what the nodes of `run` say: launchers that wait for a reader go on."""
        raise_file_limit()
        for node in self._piped:
            self._pipes.open(node)
        loop = asyncio.get_running_loop()
        for node in self._tails:
            path = self._paths.work / "out" / run / f"log_{node}.jsonl"
            put = partial(self._pipes.write_fields, node=node)
            is_busy = partial(self._pipes.is_busy, node)
            place, watch = self._paths.node_place(node), self._holds[node].look
            tail = JsonlTail(loop, path, put, is_busy, place, watch)
            self._tails[node] = tail
            tail.start()

    def adopt(self, node: str, pid: int) -> None:
        """Dora has executed `node`: name its lines, and move it if the launcher has not."""
        self._pipes.set_pid(node, pid)
        if node not in self._launched:
            for process in _with_descendants(pid):
                with contextlib.suppress(OSError):  # it may be gone already
                    cgroup.move_process(self._group(node), process)

    def clear(self, node: str, pid: int) -> None:
        """Kill what `pid`, which crashed, has left of the node, before dora executes the next one.

        It would count against the limits of the next one, and may hold what that needs.
        """
        if node not in self._launched:
            return
        with contextlib.suppress(OSError, ValueError):
            if int(self._paths.node_pid(node).read_text()) == pid:  # the next one is not there yet
                cgroup.kill_group(self._group(node))

    def let_go(self) -> None:
        """The nodes are to end: from now on none of them waits for the journal."""
        for hold in self._holds.values():
            hold.end()

    def exchanging(self, node: str) -> AbstractContextManager[None]:
        """Meanwhile `node` does not wait for the journal, because it is to end."""
        hold = self._holds.get(node)
        return nullcontext() if hold is None else hold.paused()

    def forget(self, node: str) -> None:
        """The node's process has ended: what it says next comes from another one."""
        self._pipes.set_pid(node, 0)

    def has_process(self, node: str, pid: int) -> bool:
        """Whether `pid` lives and is one of the node's. Zombies do not count.

        Until its launcher has moved it, it is where the daemon is.
        """
        return any(
            pid in cgroup.pids(one) for one in (self._group(node), self._unit / cgroup.SUPERVISOR)
        )

    def find_oom(self, node: str) -> Oom | None:
        """What the kernel has just killed `node` for, if it was for want of memory."""
        return self.resources.explain(self._group(node))

    def find_oom_of_dora(self) -> Oom | None:
        """The same for dora's coordinator and daemon."""
        return self.resources.explain(self._unit / cgroup.SUPERVISOR)

    def kill(self) -> None:
        """End every node at once, and take its last words from the pipes."""
        for group in cgroup.node_groups(self._unit).values():
            cgroup.kill_group(group)
        self.drain((*self._piped, *self._tails))

    def close(self) -> None:
        """End every node, and stop to listen."""
        self.kill()
        for node, tail in self._tails.items():
            if tail is None:
                continue
            tail.close()
            self._pipes.drain(node)  # what the limit took of the very last lines
            if tail.loss:
                self._pipes.write_event("lines-lost", node, count="Some", reason=tail.loss)
        self.let_go()
        self._holds.clear()
        self._tails.clear()

    def drain(self, nodes: Iterable[str]) -> None:
        """Write what `nodes` have said so far before whatever is written next."""
        for node in nodes:
            if (tail := self._tails.get(node)) is not None:
                tail.drain()
            self._pipes.drain(node)

    async def wait_quiet(self, seconds: float) -> None:
        """Return when dora has written nothing more about its nodes' output for `seconds`."""
        tails = [tail for tail in self._tails.values() if tail is not None]
        while sum(tail.drain() for tail in tails):
            await asyncio.sleep(seconds)

    def sample(self, now_us: int) -> CpuSample:
        """CPU time used so far by the cell and by each node."""
        groups = {WHOLE_CELL: self._unit, **cgroup.node_groups(self._unit)}
        use = {key: cgroup.read_cpu(path) for key, path in groups.items()}
        return CpuSample(
            now_us,
            {key: one.cpu_us for key, one in use.items()},
            {key: one.throttling for key, one in use.items() if any(one.throttling)},
        )


def raise_file_limit() -> None:
    """Let this process have as many open files as it may: it needs four for each node.

    Not before coordinator and daemon run: theirs is dora's business, the daemon raises its own.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _with_descendants(pid: int) -> list[int]:
    found = [pid]
    for known in found:
        # Each of them may end at any moment, its whole directory with it.
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{known}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
    return found


async def wait_eof(fd: int) -> None:
    """Return at the end of file of `fd`, whatever comes before it."""
    loop = asyncio.get_running_loop()
    done = asyncio.Event()

    def read() -> None:
        with contextlib.suppress(BlockingIOError):
            if not os.read(fd, 4096):
                loop.remove_reader(fd)
                done.set()

    loop.add_reader(fd, read)
    await done.wait()
