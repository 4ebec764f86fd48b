"""Sends requests to dora for the runner: carries out the actions of decisions/life/table.py.

Each action is a request to the coordinator, or a signal to one of dora's processes. Its answer
becomes an event of the pump, and so does every exception.
"""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from dora_systemd.adapters.dora import engine
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.extra import ID_PREFIX, PROBE, RECORDER, is_extra
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import essential_nodes, rights_of
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.dora import life_events, protocol
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.node_table import held, lacking, with_process
from dora_systemd.decisions.life.states import Cell, Do, State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.clock import Gaps, Ticks
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.cell.failure import Tasks, failed
from dora_systemd.runner.cell.pump import Pump, now_us
from dora_systemd.runner.cell.restarts import Hold, no_hold
from dora_systemd.runner.nodes.nodes import Nodes
from dora_systemd.values import SECOND

_SETTLE_SECONDS = 0.02
"""Time for a child that closes its connections to begin its exit."""
_EXIT_SECONDS = 5.0
"""Time for an exit that has begun: the kernel closes connections first, and a machine can be busy.
"""
_TURNS = 5
"""Turns of the event loop that receive a signal to the runner before the exit of a child: one turn
reads the signal, the next handles it. `systemctl kill` signals all processes of the cell, the
runner first, and the pump must see the signal before the exit of a child that it killed."""
_AGAIN_SECONDS = 0.02
_QUIET_SECONDS = 0.1
_WAITING_SECONDS = 1.0
"""Time for the effect of a stop on other nodes to be seen, if there are any."""
_LONG_SECONDS = 3600.0 * 24 * 365
_REJOIN_SECONDS = 0.2
_LOST_SECONDS = 2.0
"""Time for what dora has to report of the time before a subscription."""
_NOTE_SECONDS = 1.0
"""Time for dora's next record about a node that has exited. It comes at once, but on a busy machine
there is time between the two."""


class Dialogue(Tasks):
    """Carries out each Do; every answer becomes an event of the pump.

    hold: waits until the nodes may start.
    """

    def __init__(
        self, options: RunnerOptions, pump: Pump, dora: Engine, nodes: Nodes, pipes: LogPipes
    ) -> None:
        super().__init__()
        self._options = options
        self._pump = pump
        self._engine = dora
        self._nodes = nodes
        self._pipes = pipes
        self.hold: Hold = no_hold
        self._loop = asyncio.get_running_loop()
        self._exits: dict[str, tuple[life.NodeExited, asyncio.TimerHandle]] = {}
        self._earlier: dict[str, int] = {}  # pid of each node before its last NodeSpawned

    def actions(
        self, descriptor: Mapping[str, Any], variables: Mapping[str, str]
    ) -> dict[Do, Callable[[], None]]:
        """Return the function for each Do.

        variables: added to the nodes' environment for the daemon.
        """
        self._watch_nodes()
        return {
            Do.START_DAEMON: lambda: self._start_daemon(variables),
            Do.SEND_START: lambda: self._ask(Do.SEND_START, self._send_start(descriptor)),
            Do.SUBSCRIBE: lambda: self._ask(Do.SUBSCRIBE, self._subscribe()),
            Do.OPEN_PIPES: lambda: self._nodes.listen(self._pump.cell.run),
            Do.ASK_SPAWN: lambda: self._ask(Do.ASK_SPAWN, self._ask_spawn()),
            Do.ASK_RESULT: lambda: self._ask(Do.ASK_RESULT, self._ask_result()),
            Do.ASK_STOP: lambda: self._ask(Do.ASK_STOP, self._ask_stop()),
            Do.DISMISS_DAEMON: self._dismiss_daemon,
            Do.EXIT: lambda: self._pump.end.set_result(self._pump.cell.exit),
        }

    def _watch_nodes(self) -> None:
        """Watch over the nodes that have a watchdog, from the beginning of the run."""
        if (sockets := self._nodes.notify_sockets) is not None:
            from dora_systemd.runner.nodes.watchdog import WatchdogTimers

            timers = WatchdogTimers(sockets, self._pump, self._nodes, self._options)
            self.spawn("watch over its nodes", timers.run())

    def _ask(self, what: Do, work: Coroutine[Any, Any, None]) -> None:
        self.spawn(what.value, work)

    async def raised(self, what: str, error: Exception) -> None:
        """Have the exception of a task end the cell."""
        event: life.Event
        if isinstance(error, DoraSystemdError):
            event = life.Refused(now_us(), error.message)
        else:
            event = failed(what, error)
        await self._let_exit_come()
        self._pump.push(event)

    async def _let_exit_come(self) -> None:
        """Return after ChildExited if a child is exiting: that explains a lost connection."""
        before = self._pump.cell.state
        await asyncio.sleep(_SETTLE_SECONDS)
        if self._engine.is_exiting():
            await self._pump.wait(lambda cell: cell.state is not before, _EXIT_SECONDS)

    def watch(self, child: engine.Child, on_line: Callable[[str], None] | None = None) -> None:
        """Read the output of a child process, and report its exit."""
        self._pipes.add_output(child.label, child.output, on_line, bytes(child.said))
        engine.watch(self._loop, child, self._child_exited)

    def _child_exited(self, label: str, exit: Exit) -> None:
        oom = self._nodes.find_oom_of_dora()
        event = life.ChildExited(
            now_us(), label, exit if oom is None else Exit(words=oom.text), oom
        )
        self.spawn(f"report that the {label} has exited", self._push_after_signals(event))

    async def _push_after_signals(self, event: life.Event) -> None:
        for _ in range(_TURNS):
            await asyncio.sleep(0)
        self._pump.push(event)

    def read_coordinator(self, line: str) -> None:
        """Handle a line that the coordinator printed; one of them has its port."""
        if line.startswith(engine.LISTENING) and self._pump.cell.state is State.BOOTING:
            try:
                self._engine.set_port(int(line.removeprefix(engine.LISTENING)))
            except OSError:
                reason = DoraSystemdError(
                    "it has written no token; df /run shows whether it is full"
                )
                self._pump.push(failed("use the dora coordinator", reason))
            else:
                self._pump.push(life.CoordinatorListening(now_us()))

    def _start_daemon(self, variables: Mapping[str, str]) -> None:
        self.watch(self._engine.start_daemon(variables), self._read_daemon)
        self.spawn("wait until the daemon has joined", self._wait_joined())

    def _read_daemon(self, line: str) -> None:
        event = life_events.parse_daemon_line(line, now_us())
        if event is not None:
            self._pump.push(event)

    async def _wait_joined(self) -> None:
        await self._engine.wait_joined()
        await self.hold()  # all that comes before the nodes is done within a delay
        self._pump.push(life.DaemonConnected(now_us()))

    async def _send_start(self, descriptor: Mapping[str, Any]) -> None:
        self._nodes.expect()
        run = await self._engine.start_run(descriptor, self._options.name)
        self._pipes.set_run(run)
        self._pump.push(life.RunStarted(now_us(), run))

    async def _subscribe(self) -> None:
        def subscribed() -> None:
            self._pump.push(life.Subscribed(now_us()))

        has_more = await self._engine.read_events(self._pump.cell.run, subscribed, self._hear)
        while has_more:
            has_more = await self._subscribe_again()
        await self._let_exit_come()
        self._events_ended()

    async def _subscribe_again(self) -> bool:
        """Subscribe when dora knows the run again; as read_events().

        dora forgets the run while its daemon is not connected. watch_dora() ends the cell if the
        daemon does not come back.
        """
        while True:
            await asyncio.sleep(_REJOIN_SECONDS)
            with suppress(DoraSystemdError):
                return await self._engine.read_events(
                    self._pump.cell.run,
                    lambda: self.spawn("find the ends that dora has lost", self._find_lost_ends()),
                    self._hear,
                )

    async def _find_lost_ends(self) -> None:
        """Give the cell up if a node has ended while its daemon could not report that."""
        before = self._gone()
        await asyncio.sleep(_LOST_SECONDS)
        lost = sorted(before & self._gone())
        if lost and self._pump.cell.state is State.RUNNING:
            nodes = ", ".join(node for node, _ in lost)
            reason = f"the dora daemon was not connected when a node ended: {nodes}"
            self._pump.push(life.ConnectionLost(now_us(), reason=reason))

    def _gone(self) -> set[tuple[str, int]]:
        """The nodes here, each with its last known process, of which that has ended."""
        known = self._pump.cell.nodes.items()
        pids = {(node, one.pid) for node, one in known if one.pid and self._is_here(node)}
        return {one for one in pids if not self._nodes.has_process(*one)}

    def _events_ended(self) -> None:
        """Report that the coordinator sends no more events of the run."""
        self._pump.push(life.ConnectionLost(now_us()))

    def _is_here(self, node: str) -> bool:
        """Whether the node runs on this machine; "" stands for the dataflow."""
        del node
        return True

    def _hear_elsewhere(self, record: protocol.LogRecord) -> None:
        """Handle a record of dora about a node on another machine."""

    def _is_own(self, node: str) -> bool:
        """Whether this runner has added the node, which the dataflow does not contain."""
        has = self._options.has
        return (has("owes") and is_extra(node, PROBE)) or (
            has("record") and is_extra(node, RECORDER)
        )

    def _hear(self, record: protocol.LogRecord) -> None:
        self._release_exits(record)
        if self._is_own(record.node):
            return
        if not self._is_here(record.node):
            self._hear_elsewhere(record)
            return
        event = life_events.parse_life_event(record, now_us())
        if isinstance(event, life.NodeSpawned):
            self._earlier[event.node] = self._pump.cell.nodes.get(event.node, NodeStatus()).pid
            self._nodes.adopt(event.node, event.pid, rights_of(self._options))
        if isinstance(event, life.NodeExited):
            self._pipes.read_output("daemon")  # it has printed before why it killed the node
            is_running = self._pump.cell.state is State.RUNNING
            (self._hold_exit if is_running else self._exited)(event)
        elif event is not None:
            self._pump.push(event)

    def _hold_exit(self, event: life.NodeExited) -> None:
        """Hold an exit back until dora's next record about the node, which may name the process.

        Two processes of a node can exit at about the same time: the one that was replaced, by
        SIGTERM, and the next one, which fails. A stop waits for no other record.
        """
        self._release_exit(event.node)
        timer = self._loop.call_later(_NOTE_SECONDS, self._release_exit, event.node)
        self._exits[event.node] = event, timer

    def _release_exits(self, record: protocol.LogRecord) -> None:
        if life_events.precedes_exit(record):
            return
        stale = life_events.parse_stale(record)
        for event, _ in [*self._exits.values()]:
            if record.node in ("", event.node) and (stale or self._is_explained(event)):
                self._release_exit(event.node, stale)

    def _is_explained(self, event: life.NodeExited) -> bool:
        """Whether nothing but dora explains this exit."""
        del event
        return True

    def _release_exit(self, node: str, stale: int = 0) -> None:
        if found := self._exits.pop(node, None):
            event, timer = found
            timer.cancel()
            self._exited(event, stale)

    def _exited(self, event: life.NodeExited, stale: int = 0) -> None:
        """Push an exit. stale: the pid, if dora has removed or replaced the process that exited."""
        node = self._pump.cell.nodes.get(event.node)
        if stale and (node is None or node.pid != stale):
            # Dora has cancelled the restart of that process, if there was to be one.
            self._pump.push(replace(event, is_stale=True, will_restart=False))
            return
        if stale and (kept := self._kept(event.node)):
            self._nodes.adopt(event.node, kept, rights_of(self._options))
            self._pump.push(replace(event, is_stale=True, will_restart=False, kept=kept))
            return
        is_stale = node is not None and self._nodes.has_process(event.node, node.pid)
        essential = event.node in essential_nodes(self._options)
        oom = self._nodes.find_oom(event.node)
        event = life_events.with_facts(event, is_stale, oom, essential)
        if node is not None and not is_stale:
            self._clear(event, node)
        self._pump.push(event)
        if not is_stale:
            self._nodes.forget(event.node)

    def _kept(self, node: str) -> int:
        """Return the pid of the process that dora has kept if it ended the newer one, or 0.

        A restart after the restart delay and a ReplaceNode at the same time start one process each.
        dora keeps that of ReplaceNode, which it may have started first.
        """
        earlier = self._earlier.get(node, 0)
        return earlier if earlier and self._nodes.has_process(node, earlier) else 0

    def _clear(self, event: life.NodeExited, node: NodeStatus) -> None:
        """Kill the leftovers that a next process would meet, or that a watchdog was to end."""
        if event.exit.is_failure and (event.will_restart or node.hung):
            self._nodes.clear(event.node, node.pid)

    async def _ask_spawn(self) -> None:
        params = protocol.wait_spawn_params(self._pump.cell.run)
        reply = await self._engine.ask_apart(params, _LONG_SECONDS)
        failure = protocol.parse_spawn_failure(reply)
        if failure:
            self._pump.push(life.Refused(now_us(), failure))

    async def _ask_result(self) -> None:
        while True:
            reply = await self._engine.ask(protocol.check_params(self._pump.cell.run))
            results = protocol.parse_results(reply)
            if results is not None:
                results = {node: how for node, how in results.items() if not self._is_own(node)}
                return self._pump.push(life.ResultKnown(now_us(), results))
            if self._pump.cell.state is not State.CLOSING:
                return None  # the run continues, which answers ASK_RESULT in WAITING
            await asyncio.sleep(_AGAIN_SECONDS)

    async def _ask_stop(self) -> None:
        self._nodes.let_go()
        self._pipes.expect_ends(ID_PREFIX)
        cell = self._pump.cell
        if lacking(cell.nodes) or held(cell.nodes):
            self.spawn("end the nodes that wait", self._end_waiting(cell))
        seconds = stop_timeout(cell.grace) / SECOND
        # A refusal means that dora has ended the run already. Stop sometimes gets no answer at all:
        # the deadline of the state covers that.
        await self._engine.ask_apart(protocol.stop_params(cell.run, cell.grace), seconds)
        self._pump.push(life.StopAnswered(now_us()))

    async def _end_waiting(self, cell: Cell) -> None:
        """End the launchers that wait at a gate as soon as dora stops the run.

        A node that ends before that has failed, for dora, and takes the others with it.
        """
        before = len(with_process(cell.nodes))
        await self._pump.wait(lambda now: len(with_process(now.nodes)) < before, _WAITING_SECONDS)
        self._nodes.gates.dismiss()

    def _dismiss_daemon(self) -> None:
        self._nodes.let_go()
        self._nodes.gates.dismiss()
        # Their messages about each other's exit would be noise.
        self._pipes.mute("coordinator", "daemon")
        self._ask(Do.DISMISS_DAEMON, self._dismiss_when_quiet())

    async def _dismiss_when_quiet(self) -> None:
        # The daemon writes the last output of its nodes after it has reported their exit.
        await self._nodes.wait_quiet(_QUIET_SECONDS)
        if not self._engine.dismiss_daemon():
            self._pump.push(life.ChildExited(now_us(), "daemon", Exit(words="earlier")))

    async def watch_dora(self, ticks: Ticks, seconds: float) -> None:
        """Check at each tick that neither coordinator nor daemon hangs.

        seconds: timeout for the coordinator's answer.

        While the cell stops, TimeoutStopSec= bounds it. After a time in which the cell did not run,
        dora's processes have to find each other again.
        """
        gaps = Gaps(self._loop.time)
        while True:
            with gaps.within(seconds):
                await ticks.wait()
            if self._pump.cell.state is State.RUNNING and not gaps.is_recent:
                with gaps.within(seconds):
                    silent = await self._engine.find_silent(seconds)
                if silent and not gaps.is_recent and self._pump.cell.state is State.RUNNING:
                    reason = f"the dora {silent} does not answer any more"
                    self._pump.push(life.ConnectionLost(now_us(), silent, reason))

    async def take_samples(self, seconds: float, ticks: Ticks | None = None) -> None:
        """Sample the used CPU time every `seconds`, or at each tick while nothing happens."""
        while True:
            if self._pump.sample() and ticks is not None:
                await ticks.wait()
            else:
                await asyncio.sleep(seconds)
