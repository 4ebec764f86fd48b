"""The state of a cell and the actions of the runner: the values in table.py."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit

if TYPE_CHECKING:
    from dora_systemd.decisions.cell.status import NodeStatus
    from dora_systemd.decisions.cell.stops import Stops
    from dora_systemd.decisions.descriptor.dataflow import Downstream


class State(Enum):
    """The state of a cell."""

    BOOTING = "booting"
    JOINING = "joining"
    GATHERING = "gathering"
    STARTING = "starting"
    WAITING = "waiting"
    RUNNING = "running"
    STOPPING = "stopping"
    CLOSING = "closing"
    LEAVING = "leaving"
    ENDED = "ended"


class Do(Enum):
    """Actions of the runner that need nothing but the cell."""

    START_DAEMON = "start the daemon"
    GATHER = "wait for the other machines"
    SEND_START = "send the descriptor"
    SUBSCRIBE = "subscribe to the life events of the run"
    OPEN_PIPES = "let the launchers go on"
    ASK_SPAWN = "ask whether all nodes could be executed"
    ASK_RESULT = "ask how the run ended"
    ASK_STOP = "ask dora to stop the run"
    END_NODES = "end the nodes of this machine"
    DISMISS_DAEMON = "tell the daemon to end"
    EXIT = "kill what is left and exit"


@dataclass(frozen=True)
class Record:
    """Action: write a life event of decisions/logs/journal_events.py."""

    event: str
    node: str = ""  # "" for the dataflow
    details: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Deadline:
    """Action: push DeadlinePassed in `after` µs, or never (None); replaces any other Deadline."""

    after: int | None


class StopStep(Enum):
    """What was done last to end a node, in a stop that has an order."""

    STOPPED = "stop"
    TERMINATED = "SIGTERM"
    KILLED = "SIGKILL"


@dataclass(frozen=True)
class StopNode:
    """Action: have dora send a node its stop, and push NodeOverdue `after` µs."""

    node: str
    after: int


@dataclass(frozen=True)
class EndNode:
    """Action: SIGTERM for a node, and NodeOverdue `after` µs; SIGKILL if that is None."""

    node: str
    after: int | None = None


@dataclass(frozen=True)
class GiveTime:
    """Action: push NodeOverdue of a node `after` µs from now, unless it is due later anyway."""

    node: str
    after: int


NodeAction = StopNode | EndNode | GiveTime
Action = Do | Record | Deadline | NodeAction


@dataclass(frozen=True)
class Cell:
    """The state of a cell, as its runner knows it. Moments (_us) are in µs of CLOCK_REALTIME."""

    grace: int  # µs
    started_us: int
    nodes: "Mapping[str, NodeStatus]"  # the live table
    state: State = State.BOOTING
    run: str = ""  # dora's id of the run, or ""
    ready_us: int = 0
    stop_by: str = ""  # what requested the stop, or ""
    stop_us: int = 0  # when the stop was requested, if nodes were running
    failure: str = ""  # why the cell fails, or ""
    exit: RunnerExit = RunnerExit.OK  # the future exit status of the runner
    # cause, culprits: of the failure, and the nodes that caused it
    cause: Cause = Cause.NONE
    culprits: tuple[str, ...] = ()
    downstream: "Downstream" = field(default_factory=dict)  # the nodes that depend on each node
    is_again: bool = False  # whether this process has had a run before
    is_trial: bool = False  # whether the version before can come back
    reload: bool = False  # whether the run ends for the next one in this process
    notice: str = ""  # the result of the last reload
    # whether it belongs to `doractl run`, which reports how the nodes ended also after a stop
    is_attached: bool = False
    met_us: int = 0  # when a node last got what it needs
    machine: str = ""  # the name of this machine if it is a member
    members: tuple[str, ...] = ()  # the other machines, if it is the head
    awaited: str = ""  # which machine is not connected, and why
    lost: frozenset[str] = frozenset()  # machines that had joined, and were lost
    # whether the loss of a machine leads to another run in this process
    waits_for_lost: bool = False
    # stops, stop_limit: of single nodes, and of all together in µs; ending: what ends each node now
    stops: "Stops" = field(default_factory=dict)
    stop_limit: int = 0
    ending: Mapping[str, StopStep] = field(default_factory=dict)
    awaits_head: bool = False  # whether this member stops each node when the head requests that
    early: tuple[str, ...] = ()  # nodes that ended before they called dora, and will not restart
