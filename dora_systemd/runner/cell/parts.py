"""What a run of the dataflow needs of its nodes, of their output and of dora."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

from dora_systemd.adapters.dora.engine import Child
from dora_systemd.decisions.cell.limits import NodeLimits
from dora_systemd.decisions.cell.line_rates import RateLimits
from dora_systemd.decisions.cell.status import CpuSample, LineCount
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.dora.protocol import LogRecord, Params, Reply
from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.logs.fields import Value
from dora_systemd.decisions.resources.oom import Oom


class CellResources(Protocol):
    """Memory and CPU limits, see Resources."""

    def look(self, samples: tuple[CpuSample, ...], now: CpuSample) -> Sequence[Record]:
        """What is to be said about limits that come close."""


class CellNodes(Protocol):
    """The groups and the output of all nodes, see Nodes."""

    @property
    def resources(self) -> CellResources:
        """Their limits."""

    def listen(self, run: str) -> None:
        """Begin to read what they say."""

    def adopt(self, node: str, pid: int) -> None:
        """Dora has executed a node."""

    def clear(self, node: str, pid: int) -> None:
        """Kill what a node that crashed has left."""

    def forget(self, node: str) -> None:
        """The node's process has ended."""

    def has_process(self, node: str, pid: int) -> bool:
        """Whether that process of the node lives."""

    def find_oom(self, node: str) -> Oom | None:
        """What the kernel has killed the node for."""

    def find_oom_of_dora(self) -> Oom | None:
        """The same for coordinator and daemon."""

    def let_go(self) -> None:
        """They are to end: none of them waits for the journal any more."""

    async def wait_quiet(self, seconds: float) -> None:
        """Return when dora has written nothing more of them for so long."""

    def drain(self, nodes: Iterable[str]) -> None:
        """Write what they have said so far."""

    def kill(self) -> None:
        """End all of them at once."""

    def sample(self, now_us: int) -> CpuSample:
        """CPU time used so far."""

    def add(self, node: Node, rates: RateLimits, limits: Iterable[NodeLimits]) -> None:
        """Make room for one more."""

    def remove(self, node: str) -> None:
        """One has ended and does not come back."""

    def limit(self, limits: Iterable[NodeLimits]) -> None:
        """Other limits for nodes that run."""

    def exchanging(self, node: str) -> AbstractContextManager[None]:
        """Meanwhile the node is to end."""


class CellPipes(Protocol):
    """The way of lines and events to the journal, see LogPipes."""

    def write_event(self, name: str, node: str | None = None, **details: Value) -> None:
        """Write a life event."""

    def line_counts(self) -> Mapping[str, LineCount]:
        """How many lines each node has written."""

    def add_output(self, label: str, fd: int, on_line: Callable[[str], None] | None = None) -> None:
        """Read what a child of the runner prints."""

    def mute(self, *labels: str) -> None:
        """Leave out what these children print from now on."""

    def set_run(self, run_id: str) -> None:
        """Dora's id of the run."""


class CellDora(Protocol):
    """Coordinator and daemon, see Engine. What asks them raises DoraSystemdError."""

    def set_port(self, port: int) -> None:
        """The coordinator listens."""

    def start_daemon(self, added: Mapping[str, str]) -> Child:
        """Start the daemon."""

    async def wait_joined(self) -> None:
        """Return once the daemon has registered."""

    async def find_silent(self, seconds: float) -> str:
        """The one of the two that hangs, or ""."""

    async def ask(self, params: Params) -> Reply:
        """One request that dora answers at once."""

    async def ask_apart(self, params: Params, seconds: float) -> Reply:
        """One that may take long."""

    async def start_run(self, descriptor: Mapping[str, Any], name: str) -> str:
        """Send the descriptor; dora's id of the run."""

    async def read_events(
        self, run: str, on_start: Callable[[], None], on_record: Callable[[LogRecord], None]
    ) -> None:
        """Give on the events of a run until their end."""

    def dismiss_daemon(self) -> bool:
        """Let the daemon end; False when it already has."""
