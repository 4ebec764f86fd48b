"""Answers requests to the runner's socket: about single nodes, and checks before a restart.

A request for a node is recorded before it is carried out, see decisions/cell/status.py. A restart
replaces the process as a reload does, see runner/reload/swap.py. Nothing brings back a node after
StopNode of dora. So the Hand does otherwise:

                     nobody reads the node    others read it
    stop             RemoveNode               as a restart, and its launcher waits at a closed gate
    restart after it AddNode                  opens the gate

A node with readers is only removed if it has no launcher of ours.
"""

import asyncio
import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from dora_systemd.adapters.host import notify
from dora_systemd.adapters.runner_socket.client import Request, refused_reply, unknown_request
from dora_systemd.adapters.runner_socket.listener import Answer
from dora_systemd.decisions.cell.status import (
    HELD,
    LATCHED,
    RESTART,
    STOP,
    NodeStatus,
    format_asked,
    is_stopped,
)
from dora_systemd.decisions.cell.stops import within_of
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.dora.life_events import refused_request
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.node_table import held, is_over_but_for_held
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.stop_budget import stop_timeout
from dora_systemd.decisions.life.view import initial_nodes
from dora_systemd.decisions.needs.waiting import format_wait
from dora_systemd.errors import DoraSystemdError, ExitCode, TimedOut
from dora_systemd.runner.cell.clock import extend_timeout
from dora_systemd.runner.cell.machine_role import Alone
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.check import check_start
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.sources import Sources, check_programs
from dora_systemd.runner.reload.swap import Target, of_node
from dora_systemd.trust.programs import require_user
from dora_systemd.values import SECOND, quoted


class Hand:
    """Acts on nodes of `run`, whose lock the caller holds."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._removed: set[str] = set()
        self._left: dict[str, int] = {}

    async def replace(self, target: Target) -> None:
        """End the process of a node, and start the next one. Raises DoraSystemdError."""
        with self.run.nodes.exchanging(target.node):
            await self.run.swapper.replace(target)

    async def stop(self, target: Target) -> None:
        """End a node, so that bring_back() can start it again. Raises DoraSystemdError."""
        with self.run.nodes.exchanging(target.node):
            try:
                await (self._hold(target) if self._can_hold(target) else self._remove(target))
            except DoraSystemdError:
                self._undo(target.node)
                raise

    def _undo(self, node: str) -> None:
        """Forget a stop that dora has refused: the gate would stop the next process."""
        self._removed.discard(node)
        if self._left.pop(node, None) is not None:
            self.run.nodes.gates.open(node)

    def _can_hold(self, target: Target) -> bool:
        is_here = not target.status.machine
        is_running = self.run.pump.cell.state is State.RUNNING  # else dora waits for the launcher
        return (
            target.has_readers
            and is_here
            and is_running
            and self.run.nodes.has_gate_for(target.node)
        )

    async def _hold(self, target: Target) -> None:
        node, gates = target.node, self.run.nodes.gates
        gates.add(node)
        gates.close(node)
        if target.status.state == "waiting":
            return  # its launcher is at the gate
        self._left[node] = target.status.pid
        await self.run.swapper.hold(target)

    async def _remove(self, target: Target) -> None:
        node = target.node
        self._removed.add(node)
        run, swapper = self.run.pump.cell.run, self.run.swapper
        await swapper.ask(protocol.node_params("RemoveNode", run, node, target.patience))
        if target.status.state == "waiting":
            self.run.nodes.gates.leave(node)

    async def bring_back(self, target: Target) -> None:
        """Start a node that was stopped. Raises DoraSystemdError."""
        node, gates = target.node, self.run.nodes.gates
        await self.run.nodes.wait_gone(node, self._left.pop(node, 0))
        if node in self._removed:
            seconds = stop_timeout(target.grace) / SECOND
            await self.run.pump.wait(of_node(node, lambda one: not one.pid), seconds)
            gates.reset(node)
            add = protocol.add_params(self.run.pump.cell.run, target.definition)
            await self.run.swapper.begin(add)
            self._removed.discard(node)
        elif not gates.is_for_needs(node):  # else it is opened when its needs are met
            gates.open(node)


async def end_held(run: Run) -> None:
    """Let a dataflow end when all nodes but stopped ones have ended: these could come back."""

    def is_over(cell: Cell) -> bool:
        return cell.state is State.RUNNING and is_over_but_for_held(cell.nodes)

    await run.pump.wait(is_over, None)
    for node in held(run.pump.cell.nodes):
        run.nodes.gates.leave(node)


Reply = dict[str, Any]

VERB = "node"
_UNKNOWN_CALLER = "an unknown caller"


class NodeRequests:
    """Requests for nodes of the current run, which `reloader` knows. role: of this machine.

    extend: extends the timeout of the unit's job.
    """

    def __init__(
        self,
        reloader: Reloader,
        role: Alone,
        extend: Callable[[int], object] = notify.extend_timeout,
    ) -> None:
        self._reloader, self._role, self._extend = reloader, role, extend
        self._hand: Hand | None = None

    async def answer(self, request: Mapping[str, Any]) -> Reply:
        """Answer {"verb": "node", "what": "restart", "node": ..., "by": ..., "grace": µs or null}.

        Other requests are for the reloader. Raises DoraSystemdError.
        """
        if request.get("verb") != VERB:
            of_job = self._extending() if request.get("is_job") else contextlib.nullcontext()
            with of_job:
                return await self._reloader.answer(request)
        what, node = request.get("what"), str(request.get("node"))
        by, grace = str(request.get("by") or _UNKNOWN_CALLER), request.get("grace")
        if what not in (RESTART, STOP) or not (grace is None or type(grace) is int):
            raise unknown_request(request)
        run = self._reloader.run
        if run is None:
            raise _not_running(f"cannot {what} {node}", "no node runs")
        async with run.lock:
            target = self._target(run, node, grace)
            do = self._restart if what == RESTART else self._stop
            return {"done": [await do(run, target, by)]}

    @contextlib.contextmanager
    def _extending(self) -> Iterator[None]:
        """Let `systemctl reload` wait for the reload, however short TimeoutStartSec= is."""
        extending = asyncio.create_task(extend_timeout(self._extend))
        try:
            yield
        finally:
            extending.cancel()

    def _target(self, run: Run, node: str, given: int | None) -> Target:
        status = run.pump.cell.nodes.get(node)
        if status is None:
            message = f"cannot find a node {quoted(node)} in the dataflow"
            raise DoraSystemdError(message, "", ExitCode.NOT_FOUND)
        if status.kind == "dynamic":
            hint = "it belongs to whoever has started it"
            raise DoraSystemdError(f"cannot do that: {node} is a dynamic node", hint)
        definition = self._role.definition(self._reloader.definition(node))
        cell, has_readers = run.pump.cell, self._reloader.has_readers(node)
        grace = within_of(cell.stops, node, cell.grace) if given is None else given
        return Target(node, status, definition, has_readers, grace)

    def _hand_of(self, run: Run) -> Hand:
        if self._hand is None or self._hand.run is not run:
            self._hand = Hand(run)
        return self._hand

    async def _restart(self, run: Run, target: Target, by: str) -> str:
        node, old, cell = target.node, target.status, run.pump.cell
        if old.state != "waiting":
            _require_running(cell, f"cannot restart {node}")
            if (_has_ended(old) and not is_stopped(old)) or (is_stopped(old) and old.machine):
                raise _gone(node, old)
        (new,) = initial_nodes({node: old.kind}, {"nodes": [target.definition]}, now_us()).values()
        await self._tell(run, target, life.NodeAsked(now_us(), node, RESTART, by, new))
        if old.state == "waiting":
            return f"Node waiting: {format_wait(node, old.needs, old.since_us)}"
        hand = self._hand_of(run)
        try:
            await (hand.bring_back(target) if is_stopped(old) else hand.replace(target))
        except DoraSystemdError as error:
            self._take_back(run, target, error.message)
            raise
        return f"Node restarting: {node}"

    async def _stop(self, run: Run, target: Target, by: str) -> str:
        node, old, cell = target.node, target.status, run.pump.cell
        if is_stopped(old):
            return f"Node already stopped: {node} ({format_asked(old.asked_by)})"
        if _has_ended(old):
            return f"Node not running: {node} ({_how(old)})"
        if old.state != "waiting":
            _require_running(cell, f"cannot stop {node}")
        await self._tell(run, target, life.NodeAsked(now_us(), node, STOP, by))
        try:
            await self._hand_of(run).stop(target)
        except DoraSystemdError as error:
            self._take_back(run, target, error.message)
            raise
        return f"Node stopping: {node}"

    async def _tell(self, run: Run, target: Target, event: life.NodeAsked) -> None:
        """Record a request, on the machine of the node too, before the request is carried out."""
        run.pump.push(event)
        await self._role.tell_asked(target.status.machine, event)

    def _take_back(self, run: Run, target: Target, reason: str) -> None:
        """Take back what _tell() has recorded, because dora refuses it."""
        node, old = target.node, target.status
        for event in refused_request(node, old, run.pump.cell.nodes[node], reason, now_us()):
            run.pump.push(event)
        self._role.tell_refused(old.machine, node, reason)


def _has_ended(node: NodeStatus) -> bool:
    """Whether dora has given the node up, and starts it only with the whole dataflow."""
    is_given_up = node.state == "failed" and node.policy not in (HELD, LATCHED)
    return is_given_up or node.state in ("finished", "stopped")


def _how(node: NodeStatus) -> str:
    return f"{node.state}: {node.exit}" if node.exit.is_failure else node.state


def _gone(node: str, old: NodeStatus) -> DoraSystemdError:
    message = f"cannot restart {node}: it has ended ({_how(old)})"
    hint = "doractl restart NAME starts the whole dataflow again, and this node with it"
    return DoraSystemdError(message, hint, ExitCode.NOT_RUNNING)


def _require_running(cell: Cell, problem: str) -> None:
    if cell.state is not State.RUNNING:
        is_late = cell.state in (State.STOPPING, State.CLOSING, State.LEAVING, State.ENDED)
        why = "the dataflow is stopping" if is_late else "not all nodes are ready yet"
        raise _not_running(problem, why)


def _not_running(problem: str, why: str) -> DoraSystemdError:
    hint = "doractl list NAME says what it does"
    return DoraSystemdError(f"{problem}: {why}", hint, ExitCode.NOT_RUNNING)


class Recheck:
    """Answers {"verb": "check"}: whether the dataflow could start again.

    `doractl restart` sends this request before it stops anything. The files are checked as the
    nodes' user, in their sandbox and with their environment, and the errors are those of a start.
    `answer` answers all other requests. environment: of the nodes.
    """

    def __init__(self, role: Alone, environment: Mapping[str, str], answer: Answer) -> None:
        self._role, self._environment, self._others = role, environment, answer
        role.find_own_refusal = self.find_refusal

    async def answer(self, request: Request) -> dict[str, Any]:
        """Answer one request. Raises DoraSystemdError as `answer` does."""
        if request.get("verb") != "check":
            return await self._others(request)
        refusal = await asyncio.to_thread(self.find_refusal)
        return refused_reply(refusal or await self._role.find_refusal())

    def find_refusal(self) -> DoraSystemdError | None:
        """Check the dataflow; the error that a start would end with, or None."""
        try:
            self._check()
        except TimedOut:
            return None  # a check that times out on a busy machine proves nothing about the files
        except DoraSystemdError as error:
            return error
        return None

    def _check(self) -> None:
        role, options = self._role, self._role.options
        require_user(os.geteuid(), self._environment.get("USER", ""))
        _, prepared = check_start(options, role.own(options), self._environment)
        role.check(prepared.dataflow)
        here = prepared._replace(dataflow=role.here(prepared.dataflow))
        files = Sources(options, self._environment).files(here)
        check_programs(sorted(frozenset().union(*files.values())))
