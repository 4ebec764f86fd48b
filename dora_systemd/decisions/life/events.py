"""The events of the runner's state machine: what can happen to a cell. They contain the time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar, dataclass_transform

from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.descriptor.dataflow import Downstream
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.resources.oom import Oom


@dataclass(frozen=True, repr=False, eq=False)
class Event:
    """Base of all events.

    An event without fields of its own inherits from Event, and needs no decorator.
    """

    at_us: int  # CLOCK_REALTIME µs at which the runner learned of it

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash(self.at_us)

    def __repr__(self) -> str:
        return f"{type(self).__name__}{vars(self)}"


E = TypeVar("E", bound=Event)


@dataclass_transform(eq_default=False, frozen_default=True)
def _event(kind: type[E]) -> type[E]:
    """A frozen dataclass without methods of its own: each costs time when the runner starts."""
    return dataclass(frozen=True, repr=False, eq=False)(kind)


class CoordinatorListening(Event):
    """The coordinator has printed its port and written its token."""


class DaemonConnected(Event):
    """The daemon has registered with the coordinator, and the descriptor is expanded."""


@_event
class RunStarted(Event):
    """The coordinator has accepted the descriptor."""

    run: str  # dora's own id of this run


class Subscribed(Event):
    """From here on, life events of the run arrive."""


@_event
class Refused(Event):
    """The dataflow cannot start or continue."""

    reason: str  # one line
    cause: Cause = Cause.REFUSED


@_event
class Failed(Event):
    """Code of the runner raised.

    The code can be an action of the table, a task, or a callback of the loop.
    """

    what: str  # what it could not do
    error: str  # the exception as text


@_event
class NodeSpawned(Event):
    """dora has executed a node, for the first time or again."""

    node: str
    pid: int


@_event
class NodeReady(Event):
    """The node has connected to dora."""

    node: str


class AllReady(Event):
    """dora has opened its start barrier: messages flow."""


@_event
class NodeExited(Event):
    """A process of the node has exited."""

    node: str
    exit: Exit
    will_restart: bool  # dora is going to execute it again
    is_stale: bool = False  # a newer process of the node is already running
    kept: int = 0  # the process that dora has kept, if it is not the one in the table
    oom: Oom | None = None  # the OOM kill, if the kernel killed it because of memory
    is_essential: bool = False  # the dataflow ends if the node fails finally


@_event
class NodeCascaded(Event):
    """dora has ended the node because `by` failed before it was ready."""

    node: str
    by: str


@_event
class NodeHung(Event):
    """dora's health check, or the node's watchdog, ends the node."""

    node: str
    reason: str  # such as "unresponsive for 5322ms"
    # record, details: the life event
    record: str = "node-hung"
    details: Mapping[str, str] = field(default_factory=dict)
    is_late: bool = False  # dora has executed the next process already

    @property
    def is_of_watchdog(self) -> bool:
        """Whether the node's watchdog ends it, and not dora's health check."""
        return self.record == "node-watchdog"


@_event
class NodeSilent(Event):
    """An output that the node owes has not come."""

    node: str
    output: str
    reason: str  # such as "no image for 2s"
    then: str  # one of dora_systemd.decisions.cell.owes.THEN
    silent: str  # all that is missing of the node


@_event
class NodeSpeaks(Event):
    """A missing output has arrived."""

    node: str
    output: str
    reason: str  # such as "image again after 3s"
    silent: str  # what is still missing of the node, or ""


@_event
class NodeLacks(Event):
    """The node must not run: something that it needs is missing."""

    node: str
    needs: str  # what is missing (human-readable)


@_event
class NodeMet(Event):
    """Everything that the node needs exists: its launcher starts the node."""

    node: str


@_event
class StartTimedOut(Event):
    """Not all nodes were ready within `after` µs."""

    after: int


class RunFinished(Event):
    """dora reports that all nodes of the run have exited."""


@_event
class ResultKnown(Event):
    """dora's results of an ended run."""

    results: Mapping[str, Exit] = field(default_factory=dict)  # by node id; empty: unknown


@_event
class ChildExited(Event):
    """A child process has exited."""

    child: str  # "coordinator" or "daemon"
    exit: Exit
    oom: Oom | None = None  # as in NodeExited


@_event
class ConnectionLost(Event):
    """The coordinator has closed a control connection, or `child` does not respond."""

    child: str = "coordinator"
    reason: str = "the dora coordinator closed the control connection"


@_event
class StopAsked(Event):
    """A stop request."""

    by: str  # SIGTERM, SIGINT or, if attached, the end of standard input


class StopAnswered(Event):
    """dora's reply to our Stop: every node has ended."""


@_event
class NodeOverdue(Event):
    """A node that received its stop has not ended in its time."""

    node: str


@_event
class NodeExtends(Event):
    """A node that stops sends EXTEND_TIMEOUT_USEC=."""

    node: str
    wanted: int  # µs from now
    passed_us: int  # since the stop began, by CLOCK_MONOTONIC


@_event
class NodeAsked(Event):
    """A restart or a stop of one node was requested, and follows."""

    node: str
    what: str  # RESTART or STOP of cell/status.py
    by: str  # who, and by which door
    status: NodeStatus | None = None  # the initial status of the next process after a restart


@_event
class NodeKept(Event):
    """Dora refuses a request for the node, whose process continues, or has just ended by itself."""

    node: str
    status: NodeStatus  # before the request


@_event
class NodeReloading(Event):
    """The runner is about to end the node, and to start another process in its place."""

    node: str
    # the initial status of the new process, or None if there will be none
    status: NodeStatus | None = None


@_event
class NodeAdded(Event):
    """The node is new in the descriptor."""

    node: str
    status: NodeStatus  # its initial status


@_event
class NodeRemoved(Event):
    """The node is no longer in the descriptor, and its process has ended."""

    node: str


@_event
class ReloadNoted(Event):
    """The result of the last reload."""

    notice: str  # what to show as long as it is true, or ""
    downstream: Downstream | None = None  # the nodes that depend on each node, if that has changed
    essential: tuple[str, ...] = ()  # the nodes that the dataflow needs, if the reload has failed


class ReloadAsked(Event):
    """The dataflow as a whole has to start again."""


@_event
class MachinesAwaited(Event):
    """A member is not connected."""

    text: str  # which one and why (human-readable)


@_event
class MachineJoined(Event):
    """The dora daemon of a member has joined."""

    machine: str


class Gathered(Event):
    """All members have joined."""


@_event
class MachineLost(Event):
    """A member does not take part in the run any more."""

    machine: str
    reason: str
    by: str = ""  # the user who stopped its part on that machine, or ""
    # whether its part has failed, while the machine and the way to it are well
    is_failure: bool = False
    is_waiting: bool = False  # its nodes still run, and wait for the head to stop them


@_event
class HeadStops(Event):
    """To a member: the head has dora stop all nodes."""

    by: str  # who requested the stop of the head
    # µs if the nodes have an order: each is stopped by a NodeTurn, and a second HeadStops without a
    # limit follows when no machine has a node any more
    limit: int = 0


@_event
class NodeTurn(Event):
    """To a member: in the order of a stop it is the turn of a node there."""

    node: str
    within: int  # µs until SIGTERM


@_event
class HeadLost(Event):
    """To a member: the head is lost, or requests that the member end its nodes without dora."""

    reason: str


class DeadlinePassed(Event):
    """The current state has lasted too long."""


EVENTS = tuple(Event.__subclasses__())
"""All of them, in this order."""
