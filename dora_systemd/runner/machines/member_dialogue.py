"""Carries out the actions of a member: joins the run of the head, and handles its own nodes."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from dora_systemd.adapters.host.process import run_command
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.machines.part import is_here
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.machines.shared import MemberEngine, Patience, end_nodes
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.runner.nodes.watchdog import monotonic_us
from dora_systemd.values import SECOND

_POLL_SECONDS = 0.05
_EXPLAIN_SECONDS = 0.5
"""Time for the session to end: its reason is better than that of a lost connection to dora."""
_ASK_SECONDS = 2.0
_ANSWER_SECONDS = 1.0
"""Time for the head to receive that this part ends; included in the time of a stop."""
_FIND_SECONDS = 10.0
_UNKNOWN = ("", "offline", "unknown")
_GOING_DOWN = "the machine is shutting down"
_ENDING = (State.STOPPING, State.CLOSING, State.LEAVING, State.ENDED)


class Voice(Protocol):
    """The connection of a member to its head."""

    stops_by_head: bool  # the head knows that this part ends
    grace: int  # µs that the head leaves the nodes
    is_answered: asyncio.Event  # the head ends its own part, or is gone
    has_order: bool  # the head stops the nodes of this machine one by one
    is_going_down: Callable[[bool], bool]  # whether the machine, or the user's manager, shuts down

    def send(self, message: wire.Message) -> None:
        """Send a message to the head, if the head is connected."""


class MemberDialogue(Dialogue):
    """Carries out each Do of a member."""

    def __init__(
        self,
        options: RunnerOptions,
        pump: Pump,
        dora: MemberEngine,
        nodes: Nodes,
        pipes: LogPipes,
        voice: Voice,
    ) -> None:
        super().__init__(options, pump, dora, nodes, pipes)
        self._voice, self._dora = voice, dora
        self._has_told = self._is_cut_off = False

    def actions(
        self, descriptor: Mapping[str, Any], variables: Mapping[str, str]
    ) -> dict[Do, Callable[[], None]]:
        """Return the actions of a single machine, without requests that the head sends to dora."""
        own = super().actions(descriptor, variables)
        return {
            **own,
            Do.GATHER: self._report_ready,
            Do.ASK_SPAWN: lambda: self.spawn("find processes", find_pids(self._pump, self._nodes)),
            Do.ASK_RESULT: self._tell_result,
            Do.ASK_STOP: lambda: self._ask(Do.END_NODES, self._stop()),
            Do.END_NODES: self._end_without_head,
            Do.EXIT: lambda: self._exit(own[Do.EXIT]),
        }

    def _report_ready(self) -> None:
        """Report to the head that the daemon has joined. The head may start its run days later."""
        _, paths = self._nodes.places
        self._nodes.expect()
        self._voice.send(wire.Ready(str(paths.work)))

    def join(self, run: str) -> None:
        """Take part in the run that the head has started."""
        if self._pump.cell.state is State.GATHERING:
            self._pipes.set_run(run)
            self._pump.push(life.RunStarted(now_us(), run))

    def _events_ended(self) -> None:
        self.spawn("see why dora is silent", self._lose_head("the dora coordinator is gone"))

    async def raised(self, what: str, error: Exception) -> None:
        """Have an exception end the cell; what dora does not answer is because of the head."""
        if isinstance(error, DoraSystemdError):
            await self._lose_head(error.message)
        else:
            await super().raised(what, error)

    async def _lose_head(self, why: str) -> None:
        await asyncio.sleep(_EXPLAIN_SECONDS)
        if self._pump.cell.state not in _ENDING:
            self._has_told = True
            self._voice.send(wire.Ended(why))
            self._pump.push(life.HeadLost(now_us(), why))

    def _is_here(self, node: str) -> bool:
        return not node or is_here(self._options, node)

    def _tell_result(self) -> None:
        """Push the ends of this machine's nodes, from its table: the head may be gone already."""
        cell = self._pump.cell
        if cell.state is State.CLOSING:
            results = {ident: node.exit for ident, node in cell.nodes.items()}
            self._pump.push(life.ResultKnown(now_us(), results))

    async def _stop(self) -> None:
        """Stop the nodes for a stop requested on this machine, after notifying the head.

        Without the notice, dora may report the ends of the nodes to the head as crashes.
        """
        is_down = await asyncio.to_thread(self._is_going_down)
        self._tell_end(lambda: is_down)  # on the loop: a connection is no thread's but its own
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_ANSWER_SECONDS):
                await self._voice.is_answered.wait()
        if not self._voice.has_order:
            await self._end_nodes()

    def _is_going_down(self) -> bool:
        return self._voice.is_going_down(self._nodes.places[1].is_of_user)

    def _end_without_head(self) -> None:
        self._is_cut_off = True
        self._dora.cut_off()
        self._ask(Do.END_NODES, self._end_nodes())

    def _child_exited(self, label: str, exit: Exit) -> None:
        """Ignore the exit of the daemon while the nodes end without a head."""
        if not (self._is_cut_off and self._pump.cell.state is State.STOPPING):
            super()._child_exited(label, exit)

    async def _end_nodes(self) -> None:
        cell = self._pump.cell
        self._pipes.mute("daemon")  # it does not know that we end them
        grace = min(cell.grace, self._voice.grace)
        apart = times_left(cell, self._nodes.stop_dues, monotonic_us())
        await end_nodes(self._nodes, list(cell.nodes), grace / SECOND, apart)
        self._pump.push(life.StopAnswered(now_us()))

    def _exit(self, leave: Callable[[], None]) -> None:
        self._tell_end(self._is_going_down)
        leave()

    def _tell_end(self, is_going_down: Callable[[], bool]) -> None:
        """Report once why this part ends, unless the head has ended it."""
        cell = self._pump.cell
        if self._has_told:
            return
        self._has_told = True
        if self._voice.stops_by_head:
            self._voice.send(wire.Ended())
        elif cell.stop_by:
            reason, by = (_GOING_DOWN, "") if is_going_down() else ("", cell.stop_by)
            self._voice.send(wire.Ended(reason, by, waits=int(cell.state is State.STOPPING)))
        else:
            self._voice.send(wire.Ended(cell.failure, failed=int(bool(cell.failure))))


def times_left(cell: Cell, dues: Mapping[str, int], now: int) -> dict[str, Patience]:
    """Return the time of the nodes that have one of their own. dues: of those that are stopping.

    A node that dora has stopped already gets no SIGTERM before its time is over. For any other
    SIGTERM is the stop: the end of the daemon is no event for a node. Before all nodes were ready
    no node has data to save.
    """
    own = {node: one.within for node, one in cell.stops.items() if one.within and cell.ready_us}
    half = cell.grace / 2 / SECOND
    return {
        node: Patience(max(dues[node] - now, 0) / SECOND, half)
        if node in dues
        else Patience(0.0, within / SECOND)
        for node, within in own.items()
    }


def is_going_down(is_of_user: bool) -> bool:
    """Return whether systemd stops everything, and not only this unit; see is-system-running.

    True also if systemd does not answer, as when the message bus is stopped already: a head that
    starts again in vain does less harm than a head that stays down after a reboot.
    """
    scope = ["--user"] if is_of_user else []
    with contextlib.suppress(DoraSystemdError):
        done = run_command(["systemctl", *scope, "is-system-running"], _ASK_SECONDS)
        return done.stdout.strip() in ("stopping", *_UNKNOWN)
    return True


async def find_pids(pump: Pump, nodes: Nodes) -> None:
    """Find the pids of starting nodes, until each is known or its node is not starting any more.

    dora reports the pids before a member has joined the run of the head and receives events. The
    launchers wait for the pipes, and have written their pids to files.
    """
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_FIND_SECONDS):
            while missing := _without_process(pump):
                for node in missing:
                    _tell(pump, nodes, node, nodes.noted_pid(node))
                await asyncio.sleep(_POLL_SECONDS)


def _without_process(pump: Pump) -> list[str]:
    found = pump.cell.nodes.items()
    return [ident for ident, one in found if one.state == "starting" and not one.pid]


def _tell(pump: Pump, nodes: Nodes, node: str, pid: int) -> None:
    if pid:
        nodes.adopt(node, pid)
        pump.push(life.NodeSpawned(now_us(), node, pid))
