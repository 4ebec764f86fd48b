"""What is recorded of a history: values only. The checker reads nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tests.history.steps import Step


@dataclass(frozen=True)
class Answer:
    """How a step went. at: the number of the step. status: its exit status, negative: the signal.
    was_hit: another step killed or stopped a doractl while it ran."""

    at: int
    step: Step
    status: int
    stdout: str = ""
    stderr: str = ""
    begun: float = 0.0
    ended: float = 0.0
    was_hit: bool = False


@dataclass(frozen=True)
class Sight:
    """One process of a cell, seen once. began: clock ticks since boot, see proc_pid_stat(5).
    seen_s: CLOCK_MONOTONIC, no part of what is compared."""

    cell: str
    pid: int
    began: int
    invocation: str
    group: str
    seen_s: float = field(default=0.0, compare=False)


@dataclass(frozen=True)
class Vital:
    """What a process that should stay flat holds. anonymous: RssAnon, in KiB."""

    pid: int
    began: int
    anonymous: int
    descriptors: int


@dataclass(frozen=True)
class CellView:
    """What everyone says of one cell. unit: properties of systemd. listed, why: the objects of
    `-o json`, None where there is no such dataflow. metrics: by name, those of this dataflow.
    pids: by group of the cell."""

    unit: Mapping[str, str]
    listed: Mapping[str, Any] | None = None
    why: Mapping[str, Any] | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    pids: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Look:
    """What there is when nothing changes any more. at: the number of the step.

    is_quiet: whether that came about within the bound; pace: how many times slower than an idle
    machine this one was. at_s: CLOCK_MONOTONIC.
    """

    at: int
    is_quiet: bool
    pace: float
    cells: Mapping[str, CellView]
    vitals: Mapping[str, Vital]
    at_s: float = 0.0


@dataclass(frozen=True)
class Line:
    """A numbered line in the journal: the life of a node that printed it, and its number.

    has_unit: whether journald knew the unit that it came from.
    """

    cell: str
    life: str
    number: int
    has_unit: bool = True


@dataclass(frozen=True)
class History:
    """A whole history.

    steps: as they were asked for. answers: in the order of their ends. sights: scans of all
    processes of cells, each in the order in which they were seen. printed: by cell and life of a
    node, how many lines it noted. lines: the journal's, in its order. lost: by cell, lines that the
    journal has counted as lost. restarts: by cell, when systemd has said that it restarts the unit
    by itself, CLOCK_MONOTONIC. left: what is there at the end and was not at the beginning. end:
    the answers of the commands that end the history. ran: by cell, the objects of `doractl releases
    --history`, oldest first.
    """

    steps: tuple[Step, ...] = ()
    answers: tuple[Answer, ...] = ()
    sights: tuple[tuple[Sight, ...], ...] = ()
    looks: tuple[Look, ...] = ()
    printed: Mapping[tuple[str, str], int] = field(default_factory=dict)
    lines: tuple[Line, ...] = ()
    lost: Mapping[str, int] = field(default_factory=dict)
    left: tuple[str, ...] = ()
    end: tuple[Answer, ...] = ()
    restarts: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    ran: Mapping[str, tuple[Mapping[str, Any], ...]] = field(default_factory=dict)
