"""What the runner knows of its cell, and what it can do: the values of the table in table.py."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.descriptor.wiring import Downstream
from dora_systemd.decisions.life.causes import Cause


class RunnerExit(IntEnum):
    """Exit status of the runner, so what systemd shows as ExecMainStatus; see sysexits(3head)."""

    OK = 0
    FAILED = 1
    ENGINE_LOST = 69
    NODES_FAILED = 70
    NO_DORA = 72
    NO_ACCESS = 77
    BAD_DATAFLOW = 78


class State(Enum):
    """Where a cell is in its life."""

    BOOTING = "booting"
    JOINING = "joining"
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
    SEND_START = "send the descriptor"
    SUBSCRIBE = "subscribe to the life events of the run"
    OPEN_PIPES = "let the launchers go on"
    ASK_SPAWN = "ask whether all nodes could be executed"
    ASK_RESULT = "ask how the run ended"
    ASK_STOP = "ask dora to stop the run"
    DISMISS_DAEMON = "tell the daemon to end"
    EXIT = "kill what is left and exit"


@dataclass(frozen=True)
class Record:
    """Action: write a life event of decisions/logs/events.py. node: "" for the dataflow."""

    event: str
    node: str = ""
    details: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Deadline:
    """Action: DeadlinePassed comes in `after` µs, unless the state has changed; None: never."""

    after: int | None


Action = Do | Record | Deadline


@dataclass(frozen=True)
class Cell:
    """All that the runner knows of its cell.

    grace: µs. run: dora's id of the run, or "". nodes: the live table. started_us, ready_us:
    CLOCK_REALTIME µs. stop_by: who asked to stop, or "". failure: why the cell fails, or "".
    exit: what the runner will exit with. cause, culprits: of the failure, and the nodes that it is
    about. downstream: who gets nothing any more when a node is gone.
    is_again: whether a reload has started it again in place.
    is_trial: whether the version before can come back. reload: whether it ends to be started again.
    notice: what the last reload has left to say.
    """

    grace: int
    started_us: int
    nodes: Mapping[str, NodeStatus]
    state: State = State.BOOTING
    run: str = ""
    ready_us: int = 0
    stop_by: str = ""
    failure: str = ""
    exit: RunnerExit = RunnerExit.OK
    cause: Cause = Cause.NONE
    culprits: tuple[str, ...] = ()
    downstream: Downstream = field(default_factory=dict)
    is_again: bool = False
    is_trial: bool = False
    reload: bool = False
    notice: str = ""
