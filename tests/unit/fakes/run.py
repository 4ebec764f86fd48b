"""What a run of the dataflow consists of: nodes, pipes and a dora that only note what is asked."""

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dora_systemd.adapters.dora.engine import Child
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.logs.source import OnLine
from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.decisions.cell.line_rates import RateLimits
from dora_systemd.decisions.cell.rights import NodeRights
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.dora.protocol import LogRecord, Params, Reply
from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.logs.lines import Origin, Value
from dora_systemd.decisions.resources.oom import Oom
from dora_systemd.decisions.resources.usage import CpuSample, LineCount
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.nodes.groups import Resources
from dora_systemd.runner.nodes.nodes import Nodes

Calls = list[tuple[Any, ...]]
"""What the fakes of one run were asked to do, in its order."""


class NoJournal:
    """A journald that takes nothing."""

    def send(self, entry: bytes) -> bool:
        del entry
        return False

    send_bulk = send

    def call_when_ready(self, _: asyncio.AbstractEventLoop, __: Callable[[], None]) -> None:
        """It never is."""

    def wait_ready(self, seconds: float) -> None:
        """It never is."""


class FakeResources(Resources):
    """Limits that come close when `records` says so. used: by every node and by the dataflow."""

    def __init__(self, unit: Path) -> None:
        super().__init__(unit)
        self.records: list[Record] = []
        self.used: dict[str, str] = {}

    def most(self, key: str) -> dict[str, str]:
        del key
        return self.used

    def look(self, samples: tuple[CpuSample, ...], now: CpuSample) -> list[Record]:
        del samples, now
        return self.records


class FakeNodes(Nodes):
    """The nodes of a unit whose cgroup and directory are both `root`.

    living: nodes and processes that are there. ooms: by node, and by "" for dora.
    """

    def __init__(self, root: Path, pipes: LogPipes, calls: Calls | None = None) -> None:
        super().__init__(root, CellPaths(root), pipes)
        self.calls: Calls = [] if calls is None else calls
        self.resources: FakeResources = FakeResources(root)
        self.living: set[tuple[str, int]] = set()
        self.ooms: dict[str, Oom] = {}
        self.bare: set[str] = set()

    def expect(self) -> None:
        self.calls.append(("expect",))

    def listen(self, run: str) -> None:
        self.calls.append(("listen", run))

    def adopt(self, node: str, pid: int, rights: Sequence[NodeRights] = ()) -> None:
        self.calls.append(("adopt", node, pid, *rights))

    def clear(self, node: str, pid: int) -> None:
        self.calls.append(("clear", node, pid))

    def forget(self, node: str) -> None:
        self.calls.append(("forget", node))

    def has_gate_for(self, node: str) -> bool:
        return node not in self.bare

    def has_process(self, node: str, pid: int) -> bool:
        return (node, pid) in self.living

    def find_oom(self, node: str) -> Oom | None:
        return self.ooms.get(node)

    def find_oom_of_dora(self) -> Oom | None:
        return self.ooms.get("")

    def let_go(self) -> None:
        self.calls.append(("let go",))

    async def wait_quiet(self, seconds: float) -> None:
        del seconds
        self.calls.append(("wait quiet",))

    def drain(self, nodes: Iterable[str], is_live: bool = False) -> None:
        self.calls.append(("drain live" if is_live else "drain", *nodes))

    def kill(self) -> None:
        self.calls.append(("kill",))

    def sample(self, now_us: int) -> CpuSample:
        return CpuSample(now_us, {"": 1000})

    def add(self, node: Node, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        del rates, limits
        self.calls.append(("make room", node.id))

    def remove(self, node: str) -> None:
        self.calls.append(("take room", node))

    def limit(self, limits: Iterable[NodeLimits]) -> None:
        self.calls.append(("limit", *(one.node for one in limits)))

    @contextmanager
    def exchanging(self, node: str) -> Iterator[None]:
        self.calls.append(("begin", node))
        try:
            yield
        finally:
            self.calls.append(("end", node))


class FakePipes(LogPipes):
    """events: what was written. broken: life events that cannot be. lines: how many, by node."""

    def __init__(self, calls: Calls | None = None) -> None:
        super().__init__(asyncio.get_running_loop(), NoJournal(), Origin("robot", "uuid"))
        self.calls: Calls = [] if calls is None else calls
        self.events: list[tuple[str, str | None, dict[str, Value]]] = []
        self.broken: set[str] = set()
        self.outputs: dict[str, OnLine] = {}
        self.lines: dict[str, LineCount] = {}
        self.expected: list[str] = []

    def write_event(self, name: str, node: str | None = None, **details: Value) -> None:
        if name in self.broken:
            raise OSError(28, "No space left on device")
        self.calls.append(("event", name))
        self.events.append((name, node, details))

    def line_counts(self) -> dict[str, LineCount]:
        return self.lines

    def add_output(self, label: str, fd: int, on_line: OnLine = None, said: bytes = b"") -> None:
        del fd, said
        self.outputs[label] = on_line

    def expect_ends(self, prefix: str) -> None:
        self.expected.append(prefix)

    def mute(self, *labels: str) -> None:
        self.calls.append(("mute", *labels))

    def set_run(self, run_id: str) -> None:
        self.calls.append(("run is", run_id))

    def reasons(self, name: str) -> list[Value]:
        """The reasons of all events `name`."""
        return [details["reason"] for event, _, details in self.events if event == name]


class FakeDora(Engine):
    """A coordinator that gives each request the next of its `answers`, and is silent without one.

    An answer is a result, or an error to raise; then: what happens meanwhile. silent: who hangs.
    """

    def __init__(self, calls: Calls | None = None) -> None:
        super().__init__("/bin/dora", CellPaths(Path("/nowhere")), {})
        self.calls: Calls = [] if calls is None else calls
        self.asked: list[Params] = []
        self.answers: defaultdict[str, deque[Any]] = defaultdict(deque)
        self.then: dict[str, Callable[[], object]] = {}
        self.refuses: dict[str, str] = {}
        self.hear: Callable[[LogRecord], None] | None = None
        self.closed, self.joined = asyncio.Event(), asyncio.Event()
        # How often `closed` is the end of the subscription only, and dora then refuses another one.
        self.unsubscribes = self.forgets = 0
        self.port = 0
        self.silent = ""
        self.hangs = False
        self.has_daemon = True
        self.exits = False
        self.daemon: Callable[[Mapping[str, str]], Child] | None = None

    def set_port(self, port: int) -> None:
        self.port = port

    def start_daemon(self, added: Mapping[str, str]) -> Child:
        assert self.daemon is not None
        return self.daemon(added)

    async def wait_joined(self) -> None:
        await self.joined.wait()

    def is_exiting(self) -> bool:
        return self.exits

    async def find_silent(self, seconds: float) -> str:
        self.calls.append(("find silent", seconds))
        if self.hangs:
            await asyncio.Event().wait()
        return self.silent

    async def ask(self, params: Params) -> Reply:
        name = params if isinstance(params, str) else next(iter(params))
        self.asked.append(params)
        self.calls.append(("ask", name, *_node(params)))
        if name in self.refuses:
            return Reply("", None, self.refuses[name])
        if self.answers[name]:
            answer = self.answers[name].popleft()
        elif name in self.then:
            answer = {}
        else:
            return await self._hang()
        if isinstance(answer, Exception):
            raise answer
        self.then.get(name, lambda: None)()
        return Reply("", answer, "")

    async def ask_apart(self, params: Params, seconds: float) -> Reply:
        try:
            async with asyncio.timeout(seconds):
                return await self.ask(params)
        except TimeoutError:
            raise DoraSystemdError("cannot get an answer from dora: no reply in time") from None

    async def start_run(self, descriptor: Mapping[str, Any], name: str) -> str:
        reply = await self.ask({"Start": {"dataflow": descriptor, "name": name}})
        return str(reply.result)

    async def read_events(
        self, run: str, on_start: Callable[[], object], on_record: Callable[[LogRecord], None]
    ) -> bool:
        self.calls.append(("subscribe", run))
        if self.forgets:
            self.forgets -= 1
            raise DoraSystemdError("cannot read events of dora: no running dataflow")
        self.hear = on_record
        on_start()
        await self.closed.wait()
        has_more, self.unsubscribes = self.unsubscribes > 0, max(self.unsubscribes - 1, 0)
        if has_more:
            self.closed.clear()
        return has_more

    def dismiss_daemon(self) -> bool:
        self.calls.append(("dismiss",))
        return self.has_daemon

    async def _hang(self) -> Reply:
        await asyncio.Event().wait()
        raise AssertionError


def _node(params: Params) -> tuple[str, ...]:
    """The node that a request is about, if it is about one."""
    body = {} if isinstance(params, str) else next(iter(params.values()))
    node = body.get("node_id") or (body.get("node") or {}).get("id")
    return (node,) if node else ()
