"""The head of a dataflow with several machines: it has the coordinator, and waits for its members.

A member that is not there before the run is waited for. One that is lost later ends the run.
"""

import asyncio
import contextlib
import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from signal import SIGABRT
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.dora.preparation import Prepared
from dora_systemd.adapters.host import notify
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.adapters.runner_socket.client import Request
from dora_systemd.adapters.runner_socket.door import Door
from dora_systemd.adapters.runner_socket.listener import Ends, Session, refuse
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.machines import format_missing, members_of, placed_on
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.cell.rights import essential_nodes
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.dora import life_events, protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.node_table import busy_machines
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.machines.part import check_placed, format_differing, is_here, with_works
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.boot import EarlyDaemon
from dora_systemd.runner.cell.clock import Gaps
from dora_systemd.runner.cell.dialogue import Dialogue
from dora_systemd.runner.cell.engine import SILENCE, Engine
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.cell.restarts import Life, is_transient
from dora_systemd.runner.machines.boot import (
    HeadBoot,
    choose_ports,
    head_arguments,
    shared_environment,
)
from dora_systemd.runner.machines.roster import Roster, find_unreached
from dora_systemd.runner.machines.shared import NOISE, Shared, SharedEngine, end_nodes, find_others
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.values import INFINITY, SECOND, format_duration

if TYPE_CHECKING:
    from dora_systemd.adapters.dora.check import DoraCheck
    from dora_systemd.runner.machines.order import SpreadStops

FIRST_PATIENCE = 30 * SECOND
"""µs that a start by hand waits for members if the settings have no timeout."""
_AGAIN_SECONDS = 0.05
_LOOK_SECONDS = 0.2
_WATCH_SECONDS = 2.0
_WORD_SECONDS = 1.0
"""Time for a member to report why its daemon has ended, or why it ended a node."""
_EXTEND_SECONDS = 10.0
_TOLD_SECONDS = 3.0
"""Longer than a member takes until its table comes, with the next beat."""


class Head(Shared):
    """The machine where the dataflow was started."""

    def __init__(self, options: RunnerOptions, this_life: Life, boot: EarlyDaemon | None) -> None:
        super().__init__(options, this_life)
        early = boot if isinstance(boot, HeadBoot) else None
        members = members_of(options.placed)
        self._door = early.door if early else None
        self._ports = early.ports if early else choose_ports(members, options.addresses)
        self.roster = Roster(options, self._ports)

    @property
    def door(self) -> Door | None:
        """The Door that has sent the ports to the links."""
        return self._door

    @property
    def sessions(self) -> Mapping[str, Session]:
        """The sessions by verb; the link of each machine begins a session."""
        return {"link": self.roster.link, **dict.fromkeys(("reload", "hot-reload"), self._refuse)}

    async def _refuse(self, request: Request, ends: Ends) -> None:
        del request
        message = f"cannot reload {self.options.name}: it runs on several machines"
        hint = f"doractl restart {self.options.name} starts the changed files"
        await refuse(ends, DoraSystemdError(message, hint))

    def check(self, dataflow: Dataflow) -> None:
        """Raise DoraSystemdError for a node that cannot run on its machine."""
        check_placed(self.options, dataflow)

    async def find_refusal(self) -> DoraSystemdError | None:
        """Have all members check their parts; return the error of the first that cannot start."""
        content = Path(self.options.dataflow).read_bytes()
        return await self.roster.find_refusal(hashlib.sha256(content).hexdigest())

    def prepare(self, paths: CellPaths, prepared: Prepared, check: "DoraCheck") -> None:
        """Pass to the roster what the members compare: the descriptor's digest, dora's version."""
        self.check(prepared.dataflow)
        content = Path(self.options.dataflow).read_bytes()
        # At boot nobody is present to repair a missing machine.
        is_by_hand = is_transient(self.options.name, paths.is_of_user)
        is_awaited = self.this_life.is_first and is_by_hand and not self.this_life.up_us
        self.roster.set_facts(hashlib.sha256(content).hexdigest(), check.version(), is_awaited)

    def begin_again(self, last: Cell) -> None:
        """Choose other ports: sshd on a lost machine may still hold those of the last run."""
        self._ports = choose_ports(self.roster.names, self.options.addresses)
        self.roster.begin_again(self._ports, last.lost)

    def engine(
        self, dora: str, paths: CellPaths, environment: Mapping[str, str], boot: EarlyDaemon | None
    ) -> Engine:
        """Return an Engine whose coordinator and daemon use the ports that all machines know."""
        addresses, ports = self.options.addresses, self._ports
        own = shared_environment(environment, addresses)
        more = head_arguments(ports, own, addresses)
        return SharedEngine(dora, paths, own, boot, ports.coordinator, more, self.roster.set_token)

    def cell(self, cell: Cell) -> Cell:
        """Return the cell, with the machine of each node."""
        placed = self.options.placed
        nodes = {
            ident: node._replace(machine=placed_on(placed, ident))
            for ident, node in cell.nodes.items()
        }
        return replace(
            cell,
            nodes=nodes,
            members=self.roster.names,
            lost=self.roster.lost,
            waits_for_lost=restart_of(self.options).policy != "no",
        )

    def definition(self, node: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the definition of a node with dora's directory on the node's machine."""
        (placed,) = with_works({"nodes": [node]}, self.roster.works())["nodes"]
        return dict(placed)

    async def tell_asked(self, machine: str, event: life.NodeAsked) -> None:
        """Notify a member, and wait for its table: else the member records the end as a crash."""
        if machine:
            self.roster.tell(wire.Asked(event.node, event.what, event.by))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_TOLD_SECONDS):
                    while not self.roster.has_heard(machine, event):
                        await asyncio.sleep(_AGAIN_SECONDS)

    def tell_refused(self, machine: str, node: str, reason: str) -> None:
        """Notify a member: else the member records the next crash as a requested end."""
        if machine:
            self.roster.tell(wire.Asked(node, "", reason), machine)

    def dialogue(
        self, options: RunnerOptions, pump: Pump, dora: Engine, nodes: Nodes, pipes: LogPipes
    ) -> Dialogue:
        """Return the Dialogue of a head, which waits for all members, and handles their loss."""
        assert isinstance(dora, SharedEngine)
        pipes.left_out = NOISE
        self.roster.push, self.roster.refresh = pump.push, pump.refresh
        pump.amend, pump.on_event = self.roster.amend, partial(self._tell_run, pump)
        return HeadDialogue(options, pump, dora, nodes, pipes, self.roster)

    def _tell_run(self, pump: Pump, event: life.Event) -> None:
        """Have the members join the run when the head receives its events.

        dora gives what it has reported before to the first who subscribes, and to nobody else: a
        member would take the pids of the nodes here.
        """
        if isinstance(event, life.Subscribed):
            self.roster.tell(wire.Run(pump.cell.run))

    def node_stops(
        self, pump: Pump, dora: Engine, nodes: Nodes, dialogue: Dialogue
    ) -> "SpreadStops":
        """Return what carries out a stop that has an order, on all machines."""
        from dora_systemd.runner.machines.order import SpreadStops

        return SpreadStops(pump, dora, nodes, dialogue, self.roster)


class HeadDialogue(Dialogue):
    """Carries out each Do of a head."""

    def __init__(
        self,
        options: RunnerOptions,
        pump: Pump,
        dora: SharedEngine,
        nodes: Nodes,
        pipes: LogPipes,
        roster: Roster,
    ) -> None:
        super().__init__(options, pump, dora, nodes, pipes)
        self._roster, self._dora = roster, dora
        self._ends_at, self._is_ending = 0.0, False
        self._unreached: dict[str, str] = {}
        self._differing: dict[str, list[str]] = {}
        roster.on_programs = self._compare

    def _compare(self, machine: str, told: str) -> None:
        self.spawn(f"compare the files of machine {machine}", self._look_at(machine, told))

    async def _look_at(self, machine: str, told: str) -> None:
        """Report the files that differ between a member and the head: no restart copies them."""
        found = await find_others(Path(self._options.dataflow).parent, told)
        self._differing[machine] = found
        if not found:
            return
        notice = format_differing(self._differing)
        details = {"machine": machine, "reason": format_differing({machine: found})}
        self._pipes.write_event("machine-differs", **details)
        self._pump.push(life.ReloadNoted(now_us(), notice))

    def actions(
        self, descriptor: Mapping[str, Any], variables: Mapping[str, str]
    ) -> dict[Do, Callable[[], None]]:
        """Return the actions of a single machine, with those that several machines need."""
        return {
            **super().actions(descriptor, variables),
            Do.GATHER: lambda: self._ask(Do.GATHER, self._gather()),
            Do.END_NODES: self._end_without_dora,
        }

    async def _gather(self) -> None:
        """Wait for all members; if doractl waits for the start, at most for start_timeout."""
        given = self._options.start_timeout
        most = (FIRST_PATIENCE if given == INFINITY else given) / SECOND
        try:
            async with asyncio.timeout(most if self._roster.is_awaited else None):
                await self._all_joined()
        except TimeoutError:
            named, after = self._named(), format_duration(round(most) * SECOND)
            reason = f"cannot reach {named}: no answer within {after}"
            self._pump.push(life.Refused(now_us(), reason, Cause.NO_MACHINE))
            return
        self._pump.push(life.Gathered(now_us()))
        self._begin_start_timeout()
        self.spawn("watch the other machines", self._watch_machines())

    async def _all_joined(self) -> None:
        if self._options.start_timeout != INFINITY:
            self.spawn("have systemd wait", self._extend_start())
        while True:
            self._roster.changed.clear()
            self._show_awaited()
            if not self._roster.missing() and await self._has_each():
                self._unreached = await find_unreached(self._roster.endpoints())
                if not self._unreached:
                    return
            with contextlib.suppress(TimeoutError):
                is_all = not self._roster.missing()
                async with asyncio.timeout(_AGAIN_SECONDS if is_all else None):
                    await self._roster.changed.wait()

    def _show_awaited(self) -> None:
        if (text := f"waiting for {self._named()}") != self._pump.cell.awaited:
            self._pump.push(life.MachinesAwaited(now_us(), text))

    async def _has_each(self) -> bool:
        """Whether dora has exactly one daemon of each member.

        The coordinator may still have the lost one of a machine that is back.
        """
        with contextlib.suppress(DoraSystemdError):
            found = [machine for machine, _ in await self._dora.heartbeats()]
            return all(found.count(name) == 1 for name in self._roster.names)
        return False

    def _named(self) -> str:
        missing = self._roster.missing() or self._unreached
        if not missing:
            return "the dora daemons of all machines"
        return format_missing(missing)

    async def _extend_start(self) -> None:
        """Extend TimeoutStartSec= by the time of the wait for machines, see sd_notify(3)."""
        while self._pump.cell.state is State.GATHERING:
            notify.extend_timeout(round(3 * _EXTEND_SECONDS * SECOND))
            await asyncio.sleep(_EXTEND_SECONDS)
        notify.extend_timeout(2 * self._options.start_timeout)

    def _begin_start_timeout(self) -> None:
        after = self._options.start_timeout
        if after != INFINITY:
            late = life.StartTimedOut(now_us(), after)
            self._loop.call_later(after / SECOND, self._pump.push, late)

    async def _watch_machines(self) -> None:
        """Find a connected member whose daemon has disconnected or hangs."""
        gaps = Gaps(self._loop.time)
        while True:
            with gaps.within(_WATCH_SECONDS):
                await asyncio.sleep(_WATCH_SECONDS)
            if gaps.is_recent:
                continue
            if self._pump.cell.state in (State.WAITING, State.RUNNING) and (
                lost := await self._find_lost()
            ):
                await asyncio.sleep(_WORD_SECONDS)
                self._lose(*lost, is_failure=lost[0] not in self._roster.silent())

    async def _find_lost(self) -> tuple[str, str] | None:
        with contextlib.suppress(DoraSystemdError):
            ages = dict(await self._dora.heartbeats())
            for name in self._roster.names:
                if name not in ages:
                    return name, "its dora daemon is not connected any more"
                if ages[name] > SILENCE * SECOND:
                    return name, "its dora daemon does not answer any more"
        return None  # watch_dora sees a coordinator that does not answer

    def _lose(self, name: str, why: str, is_failure: bool = False) -> None:
        if self._pump.cell.state in (State.WAITING, State.RUNNING, State.STOPPING):
            self._pump.push(life.MachineLost(now_us(), name, why, is_failure=is_failure))

    async def _send_start(self, descriptor: Mapping[str, Any]) -> None:
        await super()._send_start(with_works(descriptor, self._roster.works()))

    def _is_here(self, node: str) -> bool:
        return not node or is_here(self._options, node)

    def _hear_elsewhere(self, record: protocol.LogRecord) -> None:
        event = life_events.parse_life_event(record, now_us())
        if isinstance(event, life.NodeSpawned):
            self._release_exit(event.node)
            self._roster.pids[event.node] = event.pid
            event = replace(event, pid=0)  # here another process has that number
        if isinstance(event, life.NodeExited):
            essential = event.node in essential_nodes(self._options)
            self._hold_exit(life_events.with_facts(event, False, None, essential))
        elif event is not None:
            self._pump.push(event)

    def _is_explained(self, event: life.NodeExited) -> bool:
        """Whether no member may have ended the node: its report takes another way than dora's."""
        status = self._pump.cell.nodes.get(event.node, NodeStatus())
        return self._is_here(event.node) or event.exit != exit_of(-SIGABRT) or bool(status.hung)

    def _exited(self, event: life.NodeExited, stale: int = 0) -> None:
        if self._is_here(event.node):
            super()._exited(event, stale)
            return
        status = self._pump.cell.nodes.get(event.node)
        is_due = status is not None and status.state in ("reloading", "stopped")
        self._pump.push(replace(event, is_stale=bool(stale) and not is_due))

    async def _ask_stop(self) -> None:
        self._begin_end()
        if silent := self._roster.silent():
            self._lose(silent[0], "it does not answer")
            self._end_without_dora()
            return
        self._roster.tell(wire.Stopping(self._pump.cell.stop_by))
        self.spawn("see whether a machine falls silent", self._watch_silence())
        await super()._ask_stop()

    def _lose_silent(self) -> bool:
        """Report the loss of a machine with nodes that falls silent during a stop."""
        needed = busy_machines(self._pump.cell.nodes)
        if silent := next((name for name in self._roster.silent() if name in needed), ""):
            self._lose(silent, "it does not answer")
        return bool(silent)

    async def _watch_silence(self) -> None:
        while self._pump.cell.state is State.STOPPING and not self._lose_silent():
            await asyncio.sleep(_LOOK_SECONDS)

    def _begin_end(self) -> float:
        """Return the seconds left of the grace duration, which begins with the first call."""
        now = time.monotonic()
        self._ends_at = self._ends_at or now + self._pump.cell.grace / SECOND
        return max(self._ends_at - now, 0.0)

    def _end_without_dora(self) -> None:
        if not self._is_ending:
            self._is_ending = True
            self._ask(Do.END_NODES, self._end_nodes())

    async def _end_nodes(self) -> None:
        """End the nodes of this machine, while the members end theirs."""
        left = self._begin_end()
        self._roster.close()
        self._roster.tell(wire.StopPart(min(round(left * SECOND), self._pump.cell.grace)))
        self._pipes.mute("coordinator", "daemon")  # they do not know that we end them
        own = [node for node in self._pump.cell.nodes if self._is_here(node)]
        await end_nodes(self._nodes, own, left)
        self._pump.push(life.StopAnswered(now_us()))
