"""The facts that `doractl why` uses, and its verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.views.dataflows import FAILED, RESTARTING, UP_WORDS
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.why.lives import Happening


@dataclass(frozen=True)
class Facts:
    """The current state from systemd and the runner, in addition to the journal."""

    status: str = ""  # a word of `list`
    text: str = ""  # STATUS=
    failed: Mapping[str, str] = field(default_factory=dict)  # nodes that failed and stay down
    restarting: tuple[str, ...] = ()  # nodes that wait for a restart
    now_boot: str = ""  # id of this boot
    restarts: int | None = None  # NRestarts= of the unit, None if systemd has unloaded it
    # nodes of which an owed output is missing, and which
    silent: Mapping[str, str] = field(default_factory=dict)
    is_held: bool = False  # whether systemd has not begun the start that it has in its queue
    is_gathering: bool = False  # whether it waits for another machine
    # nodes that were stopped by a request, and who requested that
    stopped: Mapping[str, str] = field(default_factory=dict)
    policy: str = ""  # its restart policy, "" if that is not known


@dataclass(frozen=True)
class Restart:
    """One restart."""

    at_us: int
    owner: str  # "dora" for a node, "systemd" for the dataflow
    node: str
    reason: str  # its cause


@dataclass(frozen=True)
class Verdict:
    """The verdict on a dataflow: what happened, and why."""

    status: str  # a word of `list`
    cause: Cause = Cause.NONE
    summary: str = ""  # what ended and how
    now: str = ""  # STATUS= of a running one
    node: str = ""  # the node that failed first, or ""
    # at_us: time of the failure. began_us, ready_us: beginning of that life, and when all nodes
    # were ready. CLOCK_REALTIME µs, 0: unknown.
    at_us: int = 0
    began_us: int = 0
    ready_us: int = 0
    invocation: str = ""  # systemd's id of that life
    stopped_by: str = ""
    is_given_up: bool = False  # systemd's start limit is reached
    is_passing: bool = False  # dora restarts the node
    details: Mapping[str, str] = field(default_factory=dict)  # other facts about the end
    starved: tuple[str, ...] = ()  # nodes downstream
    restarts: tuple[Restart, ...] = ()  # those that `list` counts, oldest first
    timeline: tuple[Happening, ...] = ()
    before: str = ""  # how the life before these ended, and when
    before_us: int = 0
    nodes: tuple[NodeRow, ...] = ()  # of a dataflow that has ended, as its events name them
    # nodes of a running dataflow that were stopped by a request, and who requested that
    stopped: Mapping[str, str] = field(default_factory=dict)
    policy: str = ""  # see Facts
    others: tuple[str, ...] = ()  # nodes that failed by themselves after `node`

    @property
    def is_up(self) -> bool:
        """Whether it is running, starting or stopping."""
        return self.status in UP_WORDS

    @property
    def is_away(self) -> bool:
        """Whether a node of a running dataflow has ended and will not restart."""
        is_there = self.cause is Cause.NODE_SILENT and "exit" not in self.details
        is_kept = self.is_passing or self.status == RESTARTING or is_there
        return self.is_up and bool(self.node) and not is_kept

    @property
    def is_failure(self) -> bool:
        """Whether something failed that no restart has fixed."""
        if self.status in (FAILED, RESTARTING):
            return True
        return self.is_up and bool(self.node) and not self.is_passing
