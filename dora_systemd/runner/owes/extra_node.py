"""A node of our own among those of a run: it is in no table, and `Dialogue` leaves it out.

Each has an id of its own, because dora adds no node again that has ended.
"""

from collections.abc import Awaitable, Callable
from typing import Any

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.extra import extra_id
from dora_systemd.decisions.cell.status import HELD, NodeStatus
from dora_systemd.decisions.dora import protocol
from dora_systemd.decisions.life.states import State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.cell.engine import Engine
from dora_systemd.runner.reload.apply import Run
from dora_systemd.values import SECOND

Define = Callable[[], Awaitable[dict[str, Any]]]
FindPython = Callable[[], Awaitable[str]]
"""Of the interpreter with dora-rs; raises DoraSystemdError if there is none."""

_SOON, LATE = SECOND, 32 * SECOND
"""µs between two nodes; the pause doubles while none lives for LATE."""
_ANSWER_SECONDS = 30.0
_GONE = ("finished", "stopped")
_TRIES = 2
"""Nodes that end early, one after the other, before that is reported."""


class ExtraNode:
    """Adds one node, and the next one after its end.

    name: PROBE or RECORDER. longest: µs between two nodes at most.
    """

    def __init__(self, run: Run, dora: Engine, name: str, longest: int = LATE) -> None:
        self._run, self._engine, self._name, self._longest = run, dora, name, longest
        self.group = run.nodes.places[0] / f"{cgroup.NODE_PREFIX}{name}"
        self.count = 0
        self._next_us, self._pause = 0, _SOON

    @property
    def is_there(self) -> bool:
        """Whether a process of the node runs."""
        return cgroup.is_populated(self.group)

    def is_due(self, now: int) -> bool:
        """Whether a node may be added. now: CLOCK_MONOTONIC µs."""
        return now >= self._next_us and self._run.pump.cell.state is State.RUNNING

    @property
    def ends_early(self) -> bool:
        """Whether several nodes have ended early, one after the other."""
        return self._pause >= min(_SOON << _TRIES + 1, self._longest)

    def rest(self, now: int) -> bool:
        """Whether the node has lived for LATE; then the next one follows soon again."""
        if now <= self._next_us + LATE:
            return False
        self._pause = _SOON
        return True

    async def add(self, now: int, define: Define) -> str:
        """Have dora add a node; the reason if that was not possible. define: its definition."""
        self._next_us, self._pause = now + self._pause, min(2 * self._pause, self._longest)
        try:
            cgroup.make_group(self.group)
            cgroup.kill_as_one(self.group)
            definition = await define()
            params = protocol.add_params(self._run.pump.cell.run, definition)
            reply = await self._engine.ask_apart(params, _ANSWER_SECONDS)
            return protocol.first_line(reply.error) if reply.error else ""
        except DoraSystemdError as error:
            return error.message
        except OSError as error:
            return f"its group: {error.strerror}"

    async def remove(self, grace: int) -> None:
        """Have dora end the node, and kill it if dora does not. grace: µs."""
        ident = self._expect_end()
        params = protocol.node_params("RemoveNode", self._run.pump.cell.run, ident, grace)
        try:
            reply = await self._engine.ask_apart(params, _ANSWER_SECONDS)
        except DoraSystemdError:
            reply = None
        if reply is None or reply.error:
            self.kill()

    def kill(self) -> None:
        self._expect_end()
        cgroup.kill_group(self.group)

    def _expect_end(self) -> str:
        """Leave out what dora prints about the end of the node, and return the id of the node.

        On a busy machine the node may get no CPU time within the grace duration.
        """
        ident = extra_id(self._name, self.count)
        self._run.pipes.expect_ends(ident)
        return ident


def can_come(node: NodeStatus | None) -> bool:
    """Whether messages of the node can come: it runs, or may start again."""
    if node is None or node.state in _GONE:
        return False
    return node.state != "failed" or node.policy == HELD
