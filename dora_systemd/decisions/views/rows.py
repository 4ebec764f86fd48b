"""The rows of `doractl list`: facts of dataflows, their nodes and outputs."""

from collections.abc import Mapping
from typing import NamedTuple

from dora_systemd.names import release_of

SILENT = "Silent"
"""A node that runs, and sends no output that it owes."""


class OutputRow(NamedTuple):
    """An output that a node owes. within: µs. age: µs since its last message, None: none yet.

    then: one of dora_systemd.decisions.cell.owed.THEN.
    """

    output: str
    within: int
    then: str
    age: int | None = None


class NodeRow(NamedTuple):
    """One row of `list SELECTOR`. Sizes in bytes, cpu in percent of one processor, None: unknown.

    cpu_limit, memory_limit: the group's own, or None. throttled: the percentage of the time in
    which its CPU limit throttled it, None without one. since: time of its last change of state,
    CLOCK_REALTIME µs, 0: unknown. text: its own STATUS=. watchdog, sign_age: the time in which it
    must send WATCHDOG=1, and how long ago it did, in µs. essential: whether its final failure ends
    the dataflow. scheduling: as in the settings, or "". cpus: those that it may use, "" if the
    settings name none. silent: what is missing of the outputs that it owes, or "". needs: what it
    waits for, or "". machine: the other machine that it runs on, or "". stopped_by: who has asked
    for a stop of the node alone, or "".
    """

    node: str
    state: str
    pid: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    restarts: int | None = None
    max_restarts: int | None = None
    exit: str = ""
    cpu_limit: float | None = None
    memory_limit: int | None = None
    throttled: float | None = None
    since: int = 0
    text: str = ""
    watchdog: int | None = None
    sign_age: int | None = None
    essential: bool | None = None
    scheduling: str = ""
    cpus: str = ""
    silent: str = ""
    needs: str = ""
    outputs: tuple[OutputRow, ...] = ()
    machine: str = ""
    stopped_by: str = ""

    @property
    def word(self) -> str:
        """Its state as tables have it."""
        return SILENT if self.silent else self.state.capitalize()


class Holder(NamedTuple):
    """A process that inhibits restarts of a dataflow. pid: 0 if it is not known.

    node: of the dataflow to which the process belongs, or "". why: the reason that the process has
    written, or "".
    """

    pid: int
    user: str = ""
    command: str = ""
    node: str = ""
    why: str = ""


class DataflowRow(NamedTuple):
    """One row of `list`. uptime in µs; started, ended in CLOCK_REALTIME µs, 0: unknown.

    Other fields are as in NodeRow, for the whole dataflow. enabled: whether it is started at boot.
    problem: why its node table is not valid, or "". inhibitors: who inhibits its restart.
    listed_release: that in the Description= of its unit, for a row without `dataflow`. needs: what
    systemd waits for before it starts it, or ""; waits_since: since when, CLOCK_REALTIME µs.
    machines: the others that run nodes of it. machine: the name of this one, if the head is
    elsewhere, or "".
    """

    uuid: str
    name: str
    unit: str
    status: str
    dataflow: str = ""
    text: str = ""
    uptime: int | None = None
    started: int = 0
    ready: int = 0
    ended: int = 0
    nodes_alive: int = 0
    nodes_total: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    cpu_limit: float | None = None
    memory_limit: int | None = None
    throttled: float | None = None
    restarts: int | None = None
    restart_budget: Mapping[str, int | None] | None = None
    nodes: tuple[NodeRow, ...] = ()
    enabled: bool = False
    problem: str = ""
    inhibitors: tuple[Holder, ...] = ()
    listed_release: str = ""
    needs: str = ""
    waits_since: int = 0
    machines: tuple[str, ...] = ()
    machine: str = ""

    @property
    def release(self) -> str:
        """The release that it runs, "" if it was not deployed."""
        return release_of(self.dataflow) or self.listed_release
