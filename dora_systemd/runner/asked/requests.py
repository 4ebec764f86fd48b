"""Answers what people ask of single nodes at the runner's socket: a restart, or a stop.

Each is recorded before it is done, see decisions/cell/asked.py.
"""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.cell.asked import RESTART, STOP, format_asked, is_stopped
from dora_systemd.decisions.cell.exits import Exit
from dora_systemd.decisions.cell.status import HELD, LATCHED, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.decisions.life.view import initial_nodes
from dora_systemd.decisions.needs.words import format_wait
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.asked.hand import Hand
from dora_systemd.runner.cell.pump import now_us
from dora_systemd.runner.cell.role import Alone
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.swap import Target
from dora_systemd.values import quoted

Answer = dict[str, Any]

VERB = "node"
_UNKNOWN_CALLER = "an unknown caller"


class NodeRequests:
    """Requests for nodes of the current run, which `reloader` knows. role: of this machine."""

    def __init__(self, reloader: Reloader, role: Alone) -> None:
        self._reloader, self._role = reloader, role
        self._hand: Hand | None = None

    async def answer(self, request: Mapping[str, Any]) -> Answer:
        """Answer {"verb": "node", "what": "restart", "node": ..., "by": ..., "grace": µs or null}.

        Other requests are for the reloader. Raises DoraSystemdError.
        """
        if request.get("verb") != VERB:
            return await self._reloader.answer(request)
        what, node = request.get("what"), str(request.get("node"))
        by, grace = str(request.get("by") or _UNKNOWN_CALLER), request.get("grace")
        if what not in (RESTART, STOP) or not (grace is None or type(grace) is int):
            raise DoraSystemdError(f"cannot do {quoted(str(request))}", "", ExitCode.USAGE)
        run = self._reloader.run
        if run is None:
            raise _not_running("no node runs")
        async with run.lock:
            target = self._target(run, node, run.pump.cell.grace if grace is None else grace)
            do = self._restart if what == RESTART else self._stop
            return {"done": [await do(run, target, by)]}

    def _target(self, run: Run, node: str, grace: int) -> Target:
        status = run.pump.cell.nodes.get(node)
        if status is None:
            message = f"cannot find a node {quoted(node)} in the dataflow"
            raise DoraSystemdError(message, "", ExitCode.NOT_FOUND)
        if status.kind == "dynamic":
            hint = "it belongs to whoever has started it"
            raise DoraSystemdError(f"cannot do that: {node} is a dynamic node", hint)
        definition = self._role.definition(self._reloader.definition(node))
        return Target(node, status, definition, self._reloader.has_readers(node), grace)

    def _hand_of(self, run: Run) -> Hand:
        if self._hand is None or self._hand.run is not run:
            self._hand = Hand(run)
        return self._hand

    async def _restart(self, run: Run, target: Target, by: str) -> str:
        node, old, cell = target.node, target.status, run.pump.cell
        if old.state != "waiting":
            _require_running(cell)
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
            _give_up(run, node, error)
            raise
        return f"Node restarting: {node}"

    async def _stop(self, run: Run, target: Target, by: str) -> str:
        node, old, cell = target.node, target.status, run.pump.cell
        if is_stopped(old):
            return f"Node already stopped: {node} ({format_asked(old.asked_by)})"
        if _has_ended(old):
            return f"Node not running: {node} ({_how(old)})"
        if old.state != "waiting":
            _require_running(cell)
        await self._tell(run, target, life.NodeAsked(now_us(), node, STOP, by))
        await self._hand_of(run).stop(target)
        return f"Node stopping: {node}"

    async def _tell(self, run: Run, target: Target, event: life.NodeAsked) -> None:
        """Record what was asked for, on the machine of the node too, before it is done."""
        run.pump.push(event)
        await self._role.tell_asked(target.status.machine, event)


def _give_up(run: Run, node: str, error: DoraSystemdError) -> None:
    """Dora does not start the node again: it has failed if it has ended."""
    if not run.pump.cell.nodes[node].pid:
        how = Exit(words=error.message.removeprefix("cannot do that in "))
        run.pump.push(life.NodeExited(now_us(), node, how, will_restart=False))


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


def _require_running(cell: Cell) -> None:
    if cell.state is not State.RUNNING:
        is_early = cell.state is State.WAITING
        raise _not_running("not all nodes are ready yet" if is_early else "it is stopping")


def _not_running(why: str) -> DoraSystemdError:
    hint = "doractl list NAME says what it does"
    return DoraSystemdError(f"cannot restart or stop a node: {why}", hint, ExitCode.NOT_RUNNING)
