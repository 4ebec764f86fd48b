"""A member of a dataflow with several machines: it runs the nodes that the head has placed on it.

A member has a daemon and no coordinator. A member acts during one session, which begins with a
Part. At the end of the session the member stops its nodes and exits with success: the head decides
what follows. What the head has sent is in memory only.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora.command import version_numbers
from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.adapters.host import files
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.runner_socket.listener import Ends, taken_over
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import RESTART, STOP, CellStatus, NodeStatus
from dora_systemd.decisions.dora.life_events import refused_request
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.machines.part import (
    COPY_HINT,
    check_placed,
    format_digests,
    format_other_file,
    launch_files,
)
from dora_systemd.decisions.machines.usage import told_use
from dora_systemd.decisions.resources.usage import CpuSample
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.node_stops import NodeStops
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.cell.restarts import Life
from dora_systemd.runner.machines.boot import MemberBoot, no_head, shared_environment
from dora_systemd.runner.machines.lines import Lines
from dora_systemd.runner.machines.member_dialogue import MemberDialogue, is_going_down
from dora_systemd.runner.machines.shared import (
    NOISE,
    MemberEngine,
    Shared,
    own_digests,
    read_digests,
)
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.nodes.watchdog import monotonic_us
from dora_systemd.terminal_text import short_line
from dora_systemd.values import INFINITY

if TYPE_CHECKING:
    from dora_systemd.adapters.dora.check import DoraCheck

_LONGEST = 100


class Uses:
    """Reads the groups of the nodes as often as the runner samples them, and at each new stage.

    For the head, which cannot see the cgroups of this machine.
    """

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self._seen: tuple[object, str] = ((), "")
        self._told: Mapping[str, list[Any]] = {}

    def added(self, table: CellStatus) -> CellStatus:
        """Return the table of this machine, with the usage of its nodes."""
        seen = table.samples, table.stage
        if seen != self._seen:
            self._seen, self._told = seen, self._read(table)
        return table._replace(usage=self._told)

    def _read(self, table: CellStatus) -> Mapping[str, list[Any]]:
        groups = cgroup.node_groups(self._nodes.places[0])
        uses = {node: cgroup.read_usage(groups[node]) for node in table.nodes if node in groups}
        now = CpuSample(
            time.monotonic_ns() // 1000,
            {node: use.cpu_us for node, use in uses.items()},
            {node: use.throttling for node, use in uses.items()},
        )
        return {node: told_use(use, table.samples, now, node) for node, use in uses.items()}


def with_left(table: CellStatus, now: int) -> CellStatus:
    """Return the table with the time that is left in stop_dues: the head has another clock."""
    left = {node: max(due - now, 0) for node, due in table.stop_dues.items()}
    return table._replace(stop_dues=left)


class Member(Shared):
    """The role of a member. take_over: returns the connection to the head."""

    def __init__(
        self,
        options: RunnerOptions,
        this_life: Life,
        boot: EarlyDaemon | None,
        take_over: Callable[[MemberBoot], Awaitable[Ends]] = lambda boot: taken_over(
            boot.connection, boot.rest, wire.MAX_LINE
        ),
    ) -> None:
        # The head decides which failure ends the dataflow: its members only report them.
        super().__init__(options.without("owes", "essential"), this_life)
        if not isinstance(boot, MemberBoot):
            raise no_head()
        self._boot, self._take_over = boot, take_over
        self._lines: Lines | None = None
        self._dora: MemberEngine | None = None
        self._pump: Pump | None = None
        self._told = self._version = ""
        self._table: CellStatus | None = None
        self._stops: NodeStops | None = None
        self._prepared: Prepared | None = None
        self._environment: Mapping[str, str] = {}
        self._spawn: Callable[[str, Coroutine[Any, Any, None]], None] | None = None
        self._join: Callable[[str], None] = lambda _: None
        self._before: dict[str, NodeStatus] = {}  # of requests, by node
        self._has_head = asyncio.Event()
        self.stops_by_head = self.has_order = False
        self.grace = INFINITY
        self.is_answered = asyncio.Event()
        self.is_going_down: Callable[[bool], bool] = is_going_down

    def prepare(self, paths: CellPaths, prepared: Prepared, check: "DoraCheck") -> None:
        """Write the file launch/NODE of each node. Raises DoraSystemdError."""
        self._version, self._prepared = check.version(), prepared
        check_placed(self.options, prepared.dataflow)
        paths.launch.mkdir(mode=0o700, exist_ok=True)
        for node, text in launch_files(prepared.dataflow, prepared.plan).items():
            files.write_atomic(paths.launch / node, text, 0o600)

    def engine(
        self, dora: str, paths: CellPaths, environment: Mapping[str, str], boot: EarlyDaemon | None
    ) -> Engine:
        """Return the Engine with a daemon for the coordinator of the head."""
        self._environment = environment
        own = shared_environment(environment, self.options.addresses)
        self._dora = MemberEngine(dora, paths, own, boot)
        return self._dora

    def start_coordinator(self, dora: Engine) -> None:
        """Start nothing: only the head has a coordinator."""

    def cell(self, cell: Cell) -> Cell:
        return replace(cell, machine=self.options.machine)

    def dialogue(
        self, options: RunnerOptions, pump: Pump, dora: Engine, nodes: Nodes, pipes: LogPipes
    ) -> Dialogue:
        """Return the Dialogue that joins the run of the head, and handles this machine's nodes."""
        assert isinstance(dora, MemberEngine)
        pipes.left_out = NOISE
        self._pump, pump.amend = pump, partial(self._note_table, Uses(nodes))
        pump.on_event = self._tell_hung
        dialogue = MemberDialogue(options, pump, dora, nodes, pipes, self)
        self._spawn, self._join = dialogue.spawn, dialogue.join
        dialogue.spawn("receive from the head", self._hear_head())
        dialogue.spawn("report what its nodes run", self._tell_programs())
        return dialogue

    def node_stops(self, pump: Pump, dora: Engine, nodes: Nodes, dialogue: Dialogue) -> NodeStops:
        """Return what stops the nodes here in the order of the head."""
        self._stops = NodeStops(pump, dora, nodes, dialogue)
        return self._stops

    def _note_table(self, uses: Uses, table: CellStatus) -> CellStatus:
        self._table = uses.added(table)
        return table

    async def _tell_programs(self) -> None:
        """Send the digests of the nodes' files once: the files may be older than the head's."""
        if self._prepared is None:
            return
        own = self.options, self._prepared, self._environment
        with contextlib.suppress(DoraSystemdError):  # a program that is gone has its own message
            digests = await asyncio.to_thread(own_digests, *own)
            await self._has_head.wait()
            self.send(wire.Programs(format_digests(digests)))

    def _tell_hung(self, event: life.Event) -> None:
        """Report to the head why a node was ended, before dora reports the end of the node."""
        if isinstance(event, life.NodeHung):
            nodes = self._pump.cell.nodes if self._pump else {}
            pid = nodes.get(event.node, NodeStatus()).pid
            self.send(wire.Hung(event.node, event.reason, event.record, pid))

    def _send_table(self) -> None:
        """Send the table, if it has changed since the last heartbeat."""
        table = with_left(self._table, monotonic_us()).to_json() if self._table else ""
        if table != self._told and len(table) < wire.MAX_LINE // 2:
            self._told = table
            self.send(wire.Table(table))

    def send(self, message: wire.Message) -> None:
        """Send a message to the head, if the head is connected."""
        if self._lines is not None:
            self._lines.send(message)

    async def _hear_head(self) -> None:
        await self.talk(await self._take_over(self._boot))

    async def talk(self, ends: Ends) -> None:
        """Carry out the messages of the head until the connection ends."""
        part = self._boot.part
        self._lines = Lines(ends, self._send_table)
        if reason := self._other_version(part):
            self._lines.send(wire.Refused(reason, "install the same version on both machines"))
            ends.writer.close()
            self._end_by_head(reason)
            return
        assert self._dora is not None
        self._dora.set_part(part, self.options.addresses)
        self._has_head.set()
        self._push(life.CoordinatorListening(now_us()))
        why = await self._lines.talk(self._hear)
        self._lines = None
        self._end_by_head(why)

    def _other_version(self, part: wire.Part) -> str:
        """Return why two versions of dora do not work together, or ""."""
        own, other = version_numbers(self._version)[:2], version_numbers(part.dora)[:2]
        there = short_line(part.dora, _LONGEST)
        return "" if own == other else f"it has dora {self._version}, the head has {there}"

    def _hear(self, message: wire.Message) -> None:
        if isinstance(message, wire.Run):
            self._join(message.run)
        if isinstance(message, wire.Stopping | wire.StopNode):
            self._stop_in_order(message)
        if isinstance(message, wire.Asked):
            self._note_asked(message)
        if isinstance(message, wire.Check) and self._spawn is not None:
            self._spawn("check its part", self._answer_check(message.digest))
        if isinstance(message, wire.StopPart):
            self.grace = message.grace
            self._end_by_head("the head has lost another machine")

    def _note_asked(self, message: wire.Asked) -> None:
        """Record a request for a node, or that dora has refused that."""
        node, nodes = message.node, self._pump.cell.nodes if self._pump else {}
        if node not in nodes:
            return
        if message.what in (RESTART, STOP):
            self._before[node] = nodes[node]
            self._push(life.NodeAsked(now_us(), node, message.what, message.by))
        elif not message.what and (before := self._before.pop(node, None)):
            reason = short_line(message.by, _LONGEST)
            for event in refused_request(node, before, nodes[node], reason, now_us()):
                self._push(event)

    def _stop_in_order(self, message: wire.Stopping | wire.StopNode) -> None:
        """Stop all nodes, or the one whose turn it is."""
        if isinstance(message, wire.Stopping):
            self.stops_by_head = True
            if message.limit:
                self.has_order = True
                self.is_answered.set()
            self._push(life.HeadStops(now_us(), message.by or HEAD, message.limit))
        elif self._stops is not None:
            self._stops.bound(message.node, message.most)
            self._push(life.NodeTurn(now_us(), message.node, message.within))

    async def _answer_check(self, digest: str) -> None:
        error = await asyncio.to_thread(self._find_refusal, digest)
        self.send(wire.Checked(error.message, error.hint) if error else wire.Checked())

    def _find_refusal(self, digest: str) -> DoraSystemdError | None:
        flow = Path(self.options.dataflow)
        if read_digests(flow.parent, [flow.name]).get(flow.name) != digest:
            return DoraSystemdError(format_other_file(self.options.dataflow), COPY_HINT)
        return self.find_own_refusal()

    def _end_by_head(self, why: str) -> None:
        self.stops_by_head = True
        self.is_answered.set()
        self._push(life.HeadLost(now_us(), why))

    def _push(self, event: life.Event) -> None:
        if self._pump is not None:
            self._pump.push(event)
