"""The facts that `doractl why` uses, and its verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.views.dataflows import FAILED, RESTARTING, UP_WORDS
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.why.lives import Happening


@dataclass(frozen=True)
class Facts:
    """The current state from systemd and the runner, in addition to the journal.

    status: a word of `list`. text: STATUS=. failed: nodes that have failed for good. restarting:
    nodes that wait for a restart. now_boot: id of this boot. restarts: NRestarts= of the unit, None
    if systemd has unloaded it. silent: nodes of which an owed output is missing, and which.
    is_held: whether systemd has not begun the start that it has in its queue. is_gathering: whether
    it waits for another machine. stopped: nodes that somebody has stopped, and who. policy: its
    restart policy, "" if that is not known.
    """

    status: str = ""
    text: str = ""
    failed: Mapping[str, str] = field(default_factory=dict)
    restarting: tuple[str, ...] = ()
    now_boot: str = ""
    restarts: int | None = None
    silent: Mapping[str, str] = field(default_factory=dict)
    is_held: bool = False
    is_gathering: bool = False
    stopped: Mapping[str, str] = field(default_factory=dict)
    policy: str = ""


@dataclass(frozen=True)
class Restart:
    """One restart. owner: "dora" for a node, "systemd" for the dataflow. reason: its cause."""

    at_us: int
    owner: str
    node: str
    reason: str


@dataclass(frozen=True)
class Verdict:
    """What happened to a dataflow.

    status: a word of `list`. summary: what ended and how. now: STATUS= of a running one. node: the
    node that failed first, or "". others: those that failed by themselves after it. at_us: time of
    that; began_us, ready_us: beginning of that life, and when all nodes were ready; CLOCK_REALTIME
    µs, 0: unknown. invocation: systemd's id of that life. details: other facts about the end.
    is_given_up: systemd's start limit is reached. is_passing: dora restarts the node. starved:
    nodes downstream. restarts: those that `list` counts, oldest first. before: how the life before
    these ended, and when. nodes: of a dataflow that has ended, as its events name them. stopped:
    nodes of one that is up which somebody has stopped, and who. policy: see Facts.
    """

    status: str
    cause: Cause = Cause.NONE
    summary: str = ""
    now: str = ""
    node: str = ""
    at_us: int = 0
    began_us: int = 0
    ready_us: int = 0
    invocation: str = ""
    stopped_by: str = ""
    is_given_up: bool = False
    is_passing: bool = False
    details: Mapping[str, str] = field(default_factory=dict)
    starved: tuple[str, ...] = ()
    restarts: tuple[Restart, ...] = ()
    timeline: tuple[Happening, ...] = ()
    before: str = ""
    before_us: int = 0
    nodes: tuple[NodeRow, ...] = ()
    stopped: Mapping[str, str] = field(default_factory=dict)
    policy: str = ""
    others: tuple[str, ...] = ()

    @property
    def is_up(self) -> bool:
        """Whether it is running, starting or stopping."""
        return self.status in UP_WORDS

    @property
    def is_away(self) -> bool:
        """Whether a node of a running dataflow has ended for good."""
        is_there = self.cause is Cause.NODE_SILENT and "exit" not in self.details
        is_kept = self.is_passing or self.status == RESTARTING or is_there
        return self.is_up and bool(self.node) and not is_kept

    @property
    def is_failure(self) -> bool:
        """Whether something failed that no restart has fixed."""
        if self.status in (FAILED, RESTARTING):
            return True
        return self.is_up and bool(self.node) and not self.is_passing
