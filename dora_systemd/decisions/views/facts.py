"""The facts of a node: a field of NodeRow each, and a row of NODE_FACTS, which shows it everywhere.

The order of NODE_FACTS is that of JSON and of the metrics.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from dora_systemd.decisions.views.formats import (
    UNKNOWN,
    format_count,
    format_memory,
    format_percent,
    format_watchdog,
)
from dora_systemd.values import SECOND

if TYPE_CHECKING:
    from dora_systemd.decisions.cell.status import NodeStatus
    from dora_systemd.decisions.resources.containers import Container

SILENT = "Silent"
"""A node that runs, and sends no output that it owes."""
UNKNOWN_STATE = "unknown"

Labels = Mapping[str, str]
Sample = tuple[Labels, float | int]


class OutputRow(NamedTuple):
    """An output that a node owes."""

    output: str
    within: int  # µs
    then: str  # one of dora_systemd.decisions.cell.owes.THEN
    age: int | None = None  # µs since its last message, None: none yet


class NodeRow(NamedTuple):
    """One row of `list SELECTOR`. Sizes in bytes, cpu in percent of a processor; None: unknown."""

    node: str
    state: str
    pid: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    restarts: int | None = None
    max_restarts: int | None = None
    exit: str = ""
    # cpu_limit, memory_limit: the group's own, or None
    cpu_limit: float | None = None
    memory_limit: int | None = None
    # the percentage of the time in which its CPU limit throttled it, None without one
    throttled: float | None = None
    # tasks: its processes and threads; tasks_limit: the group's own, or None
    tasks: int | None = None
    tasks_limit: int | None = None
    since: int = 0  # time of its last change of state, CLOCK_REALTIME µs, 0: unknown
    text: str = ""  # its own STATUS=
    # watchdog, sign_age: the time in which it must send WATCHDOG=1, and how long ago it did, in µs
    watchdog: int | None = None
    sign_age: int | None = None
    stop_left: int | None = None  # µs that it has to stop, None if it does not stop, or unknown
    essential: bool | None = None  # whether its final failure ends the dataflow
    scheduling: str = ""  # as in the settings, or ""
    cpus: str = ""  # those that it may use, "" if the settings name none
    silent: str = ""  # what is missing of the outputs that it owes, or ""
    needs: str = ""  # what it waits for, or ""
    outputs: tuple[OutputRow, ...] = ()
    machine: str = ""  # the machine of the node, "" for this one
    stopped_by: str = ""  # who requested the stop of this node alone, or ""
    containers: "tuple[Container, ...]" = ()  # that it has started

    @property
    def word(self) -> str:
        """The state of the node as tables show it."""
        return SILENT if self.silent else self.state.capitalize()


class Fact(NamedTuple):
    """One fact, and where it is shown."""

    key: str  # in JSON
    field: str = ""  # of NodeRow, if that has another name
    # the value in JSON, from that of the field
    value: Callable[[Any], Any] = lambda value: None if value == "" else value
    # reads the fact from the runner's table; verbs/facts/list.py reads facts without it
    told: Callable[["NodeStatus"], Any] | None = None
    is_moment: bool = False  # whether it is a time, which has two keys
    # column, cell: of the table of nodes, which has the column if one of them `has` it
    column: str = ""
    cell: Callable[[NodeRow], str] | None = None
    has: Callable[[NodeRow], object] = lambda _: True
    rank: int = 0  # columns with a higher rank are further to the right
    # metric, help, samples: a metric, each sample with the labels that only this one has; without
    # `samples` it is the field, which has µs
    metric: str = ""
    help: str = ""
    samples: Callable[[NodeRow], list[Sample]] | None = None
    is_label: bool = False  # whether the metric "info" has it

    def of(self, row: Any) -> Any:
        """The field of a row; None for what a row has not."""
        return getattr(row, self.field or self.key, None)


def _cpu(row: NodeRow) -> str:
    return format_percent(row.cpu_percent, row.cpu_limit)


def _memory(row: NodeRow) -> str:
    return format_memory(row.memory, row.memory_limit)


def _restarts(row: NodeRow) -> str:
    used = format_count(row.restarts)
    return f"{used}/{row.max_restarts}" if row.max_restarts else used


def _tasks(row: NodeRow) -> str:
    limit = "" if row.tasks_limit is None else f"/{row.tasks_limit}"
    return f"{format_count(row.tasks)}{limit}"


def _count(row: NodeRow) -> list[Sample]:
    return [] if row.tasks is None else [({}, row.tasks)]


def _watchdog(row: NodeRow) -> str:
    return format_watchdog(row.sign_age, row.watchdog)


def _outputs(rows: Sequence[OutputRow]) -> list[dict[str, Any]]:
    return [
        {"output": one.output, "age_us": one.age, "within_us": one.within, "then": one.then}
        for one in rows
    ]


def _seconds(time: int | None, **labels: str) -> list[Sample]:
    return [] if time is None else [(labels, time / SECOND)]


def _state(one: "NodeStatus") -> str:
    # Imported late, as below: a list without dataflows has no node.
    from dora_systemd.decisions.cell.status import is_stopping

    return "stopping" if is_stopping(one) else one.state


def _stopped_by(one: "NodeStatus") -> str:
    from dora_systemd.decisions.cell.status import is_stopped

    return one.asked_by if is_stopped(one) else ""


def _machine(row: NodeRow) -> str:
    from dora_systemd.decisions.cell.machines import HEAD

    return row.machine or HEAD


def _ready(row: NodeRow) -> list[Sample]:
    from dora_systemd.decisions.cell.status import ALIVE_NODE_STATES

    is_there = row.state in ALIVE_NODE_STATES and row.since > 0
    return _seconds(row.since if is_there else None)


def _silent(row: NodeRow) -> list[Sample]:
    return [({}, int(bool(row.silent)))] if row.outputs else []


def _containers(some: "Sequence[Container]") -> list[dict[str, Any]]:
    return [one.values() for one in some]


def _outside(row: NodeRow) -> list[Sample]:
    return [(one.labels, one.memory or 0) for one in row.containers if not one.is_inside]


def _ages(row: NodeRow) -> list[Sample]:
    return [sample for one in row.outputs for sample in _seconds(one.age, output=one.output)]


USAGE = (
    Fact("cpu_percent", column="CPU%", cell=_cpu),
    Fact("cpu_limit_percent", "cpu_limit"),
    Fact("throttled_percent", "throttled", column="THROTTLED%",
        cell=lambda row: format_percent(row.throttled), has=lambda row: row.cpu_limit is not None),
    Fact("memory_bytes", "memory", column="MEM", cell=_memory),
    Fact("memory_peak_bytes", "memory_peak", column="PEAK",
        cell=lambda row: format_memory(row.memory_peak)),
    Fact("memory_limit_bytes", "memory_limit"),
)  # fmt: skip
"""Facts of a cgroup, which a whole dataflow has, too. Their metrics come from its counters."""

NODE_FACTS = (
    Fact("node", column="NODE"),
    Fact("machine", told=lambda one: one.machine, column="MACHINE",
        cell=_machine, has=lambda row: row.machine),
    Fact("state", told=_state,
        column="STATE", cell=lambda row: row.word),
    Fact("pid", value=lambda pid: pid or None, told=lambda one: 0 if one.is_held else one.pid,
        column="PID"),
    Fact("exit", told=lambda one: str(one.exit), column="EXIT", rank=1),
    Fact("waits_for", "needs", told=lambda one: one.needs),
    Fact("stopped_by", told=_stopped_by),
    Fact("since", told=lambda one: one.since_us, is_moment=True,
        metric="ready_time_seconds", help="When it became ready, in Unix time.", samples=_ready),
    Fact("text", column="STATUS TEXT", cell=lambda row: row.text, has=lambda row: row.text, rank=2),
    Fact("stop_left_us", "stop_left",
        metric="stop_left_seconds", help="Time that it has to stop."),
    Fact("watchdog_us", "watchdog", column="WATCHDOG", cell=_watchdog, has=_watchdog, rank=1,
        metric="watchdog_seconds", help="Time in which it must send WATCHDOG=1."),
    Fact("watchdog_age_us", "sign_age",
        metric="watchdog_age_seconds", help="Time since its last WATCHDOG=1."),
    *USAGE,
    Fact("waits_percent"),
    Fact("tasks", column="TASKS", cell=_tasks, has=lambda row: row.tasks_limit is not None,
        metric="tasks", help="Processes and threads that it has.", samples=_count),
    Fact("tasks_limit"),
    Fact("restarts", told=lambda one: one.restarts, column="RESTARTS", cell=_restarts),
    Fact("max_restarts", told=lambda one: one.max_restarts or None),
    Fact("essential", is_label=True),
    Fact("scheduling", is_label=True),
    Fact("cpus", is_label=True),
    Fact("silent", told=lambda one: one.silent,
        metric="silent", help="1 while an output that it owes is missing.", samples=_silent),
    Fact("outputs", value=_outputs, metric="last_output_age_seconds",
        help="Time since the last message of an owed output.", samples=_ages),
    Fact("containers", value=_containers, metric="outside_memory_bytes",
        help="Memory of a container that it has started outside of its cgroup.", samples=_outside),
)  # fmt: skip
_TOLD = [(one.field or one.key, one.told) for one in NODE_FACTS if one.told]


def stopping_words(rows: Sequence[NodeRow]) -> str:
    """Format what the stop waits for: "recorder: writing episode 12, 41 s left"."""
    parts = (
        f"{one.node}{one.text and f': {one.text}'}, {round(one.stop_left / SECOND)} s left"
        for one in rows
        if one.stop_left is not None
    )
    return "; ".join(parts)


def node_row(node: str, status: "NodeStatus | None", known: Mapping[str, Any]) -> NodeRow:
    """Return the row of a node. status: from the runner's table, or None. known: other fields."""
    told = {name: read(status) for name, read in _TOLD} if status else {"state": UNKNOWN_STATE}
    return NodeRow(node, **told, **known)


def node_table(rows: Sequence[NodeRow]) -> tuple[list[str], list[list[str]]]:
    """The header of the table of nodes, and the cells of each row."""
    facts = [one for one in NODE_FACTS if one.column and any(map(one.has, rows))]
    facts.sort(key=lambda one: one.rank)
    cells = [
        [one.cell(row) if one.cell else str(one.of(row) or UNKNOWN) for one in facts]
        for row in rows
    ]
    return [one.column for one in facts], cells


def node_samples(fact: Fact, row: NodeRow) -> list[Sample]:
    """The samples of the metric of a fact."""
    return fact.samples(row) if fact.samples else _seconds(fact.of(row))


def node_labels(row: NodeRow) -> Labels:
    """Return labels for what is special about a node, usually nothing."""
    found = {one.key: one.of(row) for one in NODE_FACTS if one.is_label}
    return {key: "yes" if value is True else value for key, value in found.items() if value}
