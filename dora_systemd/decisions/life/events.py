"""What can happen to a cell: the events of the runner's state machine. Time arrives inside them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.descriptor.wiring import Downstream
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.resources.oom import Oom


@dataclass(frozen=True)
class Event:
    """Base of all. at_us: CLOCK_REALTIME µs at which the runner learned of it."""

    at_us: int


@dataclass(frozen=True)
class CoordinatorListening(Event):
    """The coordinator printed its port and wrote its token."""


@dataclass(frozen=True)
class DaemonConnected(Event):
    """The coordinator says that its daemon has registered, and the descriptor is expanded."""


@dataclass(frozen=True)
class RunStarted(Event):
    """The coordinator accepted the descriptor. run: dora's own id of this run."""

    run: str


@dataclass(frozen=True)
class Subscribed(Event):
    """From here on life events of the run arrive."""


@dataclass(frozen=True)
class Refused(Event):
    """The dataflow could not be started, or cannot go on. reason: one line."""

    reason: str
    cause: Cause = Cause.REFUSED


@dataclass(frozen=True)
class Failed(Event):
    """Something of the runner raised. what: what it could not do. error: the exception, in words.

    It can be an action of the table, a task beside it, or a callback of the loop.
    """

    what: str
    error: str


@dataclass(frozen=True)
class NodeSpawned(Event):
    """Dora executed a node for the first time or again."""

    node: str
    pid: int


@dataclass(frozen=True)
class NodeReady(Event):
    """The node has connected to dora."""

    node: str


@dataclass(frozen=True)
class AllReady(Event):
    """Dora opened its start barrier: messages flow."""


@dataclass(frozen=True)
class NodeExited(Event):
    """A process of the node ended.

    exit: "" for success, else "exit code 1" or "signal SIGKILL".
    will_restart: dora is going to execute it again.
    is_stale: the process that ended had already been replaced by one that lives.
    oom: what the kernel killed it for, if it was for want of memory.
    """

    node: str
    exit: str
    will_restart: bool
    is_stale: bool = False
    oom: Oom | None = None


@dataclass(frozen=True)
class NodeCascaded(Event):
    """Dora ended the node because `by` failed before it was ready."""

    node: str
    by: str


@dataclass(frozen=True)
class NodeHung(Event):
    """Dora's health check ends the node. reason: such as "unresponsive for 5322ms"."""

    node: str
    reason: str


@dataclass(frozen=True)
class StartTimedOut(Event):
    """The nodes had `after` µs to be ready."""

    after: int


@dataclass(frozen=True)
class RunFinished(Event):
    """Dora says that no node of the run is left."""


@dataclass(frozen=True)
class ResultKnown(Event):
    """Dora's verdict on an ended run. results: node id -> "" or why it failed; empty: unknown."""

    results: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ChildExited(Event):
    """The coordinator or the daemon is gone. child: which of the two. exit: how. oom: as above."""

    child: str
    exit: str
    oom: Oom | None = None


@dataclass(frozen=True)
class ConnectionLost(Event):
    """The coordinator closed a control connection that we did not close, or `child` is silent."""

    child: str = "coordinator"
    reason: str = "the dora coordinator closed the control connection"


@dataclass(frozen=True)
class StopAsked(Event):
    """SIGTERM, SIGINT or, when attached, the end of standard input. by: which of them."""

    by: str


@dataclass(frozen=True)
class StopAnswered(Event):
    """Dora's reply to our Stop: every node has ended."""


@dataclass(frozen=True)
class NodeReloading(Event):
    """The node is about to be ended, and another one to be started in its place.

    status: what that one is before anything happened, or None when there is none.
    """

    node: str
    status: NodeStatus | None = None


@dataclass(frozen=True)
class NodeAdded(Event):
    """The node is new in the descriptor. status: how it is, before anything of it happened."""

    node: str
    status: NodeStatus


@dataclass(frozen=True)
class NodeRemoved(Event):
    """The node is no longer in the descriptor, and its process has ended."""

    node: str


@dataclass(frozen=True)
class ReloadNoted(Event):
    """What came of the last reload. notice: what to say about it as long as it holds, or "".

    downstream: who gets nothing any more when a node is gone, if that is another now.
    """

    notice: str
    downstream: Downstream | None = None


@dataclass(frozen=True)
class ReloadAsked(Event):
    """The dataflow as a whole has to start again."""


@dataclass(frozen=True)
class DeadlinePassed(Event):
    """What the current state waits for took too long."""


EVENTS: tuple[type[Event], ...] = (
    CoordinatorListening,
    DaemonConnected,
    RunStarted,
    Subscribed,
    Refused,
    Failed,
    NodeSpawned,
    NodeReady,
    AllReady,
    NodeExited,
    NodeCascaded,
    NodeHung,
    StartTimedOut,
    RunFinished,
    ResultKnown,
    ChildExited,
    ConnectionLost,
    StopAsked,
    StopAnswered,
    NodeReloading,
    NodeAdded,
    NodeRemoved,
    ReloadNoted,
    ReloadAsked,
    DeadlinePassed,
)
