"""How a cell fails: entries of TABLE in table.py, and helpers that all handlers use. Pure.

If a node ends before it has called dora, dora fails every node that waits at the start barrier,
whatever the exit status of the first node was. dora names the first node only in its errors about
the other nodes.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from dora_systemd.decisions.cell.exits import EARLY, Exit
from dora_systemd.decisions.cell.status import HELD, LATCHED
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import (
    Action,
    Cell,
    Deadline,
    Do,
    Record,
    State,
)
from dora_systemd.decisions.resources.oom import Oom, Owner
from dora_systemd.values import SECOND

Next = tuple[Cell, tuple[Action, ...]]
"""The cell after an event, and the actions of the runner."""
Handler = Callable[[Cell, Any], Next]
"""Any: each takes the events that TABLE lists it for."""

ENGINE_TIMEOUT = 30 * SECOND
"""µs; dora's own timeout for answers between its parts."""


def to(cell: Cell, state: State, *actions: Action, after: int | None = None) -> Next:
    """Change the state. after: µs until DeadlinePassed, or None."""
    return replace(cell, state=state), (*actions, Deadline(after))


_FINAL = {
    Cause.NO_MACHINE: RunnerExit.NO_MACHINE,
    Cause.MACHINE_REFUSES: RunnerExit.BAD_DATAFLOW,
    Cause.MACHINE_LOST: RunnerExit.ENGINE_LOST,
}


def refused(cell: Cell, event: life.Refused) -> Next:
    """Fail, because dora or another machine refuses the dataflow or a request."""
    code = _FINAL.get(event.cause, RunnerExit.FAILED)
    return fail(because(cell, event.cause), event.reason, code)


def because(cell: Cell, cause: Cause, nodes: Iterable[str] = ()) -> Cell:
    """Set why the cell is about to fail, and the nodes that caused it."""
    return replace(cell, cause=cause, culprits=tuple(nodes))


def broken(cell: Cell, event: life.Failed) -> Next:
    """End the cell now because of an exception in the runner."""
    cell = replace(cell, reload=False)
    if cell.failure:
        return fail(cell, cell.failure, cell.exit)  # the first failure counts
    reason = f"the runner could not {event.what}: {event.error}"
    return fail(because(cell, Cause.RUNNER_BROKEN), reason, RunnerExit.FAILED)


def fail(cell: Cell, reason: str, code: RunnerExit, **more: str) -> Next:
    """End at once, and record the reason. more: details of that record."""
    cell = replace(cell, failure=reason, exit=code)
    is_trial = cell.is_trial and not cell.ready_us and not cell.stop_by
    name = "reload-failed" if is_trial else "dataflow-failed"
    details = {"reason": reason, "cause": str(cell.cause), "nodes": " ".join(cell.culprits)}
    known = {key: text for key, text in details.items() if text} | more
    return to(cell, State.ENDED, Record(name, "", known), Do.EXIT)


def child_exited(cell: Cell, event: life.ChildExited) -> Next:
    """Fail after the exit of coordinator or daemon."""
    reason = f"the dora {event.child} is gone ({event.exit})"
    cell, actions = _lose(cell, event.child, reason, event.exit, event.oom)
    return cell, (*oom_of_all(event), *actions)


def connection_lost(cell: Cell, event: life.ConnectionLost) -> Next:
    """Handle a lost connection to the coordinator like the exit of the coordinator."""
    return _lose(cell, event.child, event.reason, Exit())


def _lose(cell: Cell, child: str, reason: str, exit: Exit, oom: Oom | None = None) -> Next:
    cell = because(cell, Cause(f"{child}-lost") if oom is None else Cause.OUT_OF_MEMORY)
    more = {} if oom is None else oom.owner_details()
    cell, actions = fail(cell, reason, RunnerExit.ENGINE_LOST, **more)
    return cell, (Record(f"{child}-lost", "", exit.details()), *actions)


def engine_deadline(cell: Cell, event: life.Event) -> Next:  # noqa: ARG001 - as all handlers
    """Fail, because dora does not answer in time."""
    reason = f"dora did not answer within {ENGINE_TIMEOUT // SECOND} s while {cell.state.value}"
    return fail(because(cell, Cause.NO_ANSWER), reason, RunnerExit.ENGINE_LOST)


def oom_of_all(event: life.Event) -> tuple[Action, ...]:
    """Return the event about the dataflow, if its own memory limit caused the kill."""
    if not isinstance(event, life.NodeExited | life.ChildExited) or event.oom is None:
        return ()
    if event.oom.owner is not Owner.DATAFLOW:
        return ()
    return (Record("dataflow-oom", "", event.oom.dataflow_details()),)


_ENDED = ("finished", "failed")


def is_doomed(cell: Cell) -> bool:
    """Whether dora fails a node that it will not restart, because another one has ended early."""
    waiting = (node for node in cell.nodes.values() if node.state == "ready")
    return bool(_still_ended(cell)) and any(node.policy == "never" for node in waiting)


def noted_early(before: Cell, after: Cell, node: str) -> Cell:
    """Add a node to `early` if it was not ready yet, and does not come back."""
    old, new = before.nodes.get(node), after.nodes[node]
    was_ready = old is not None and old.state == "ready"
    if was_ready or new.state not in _ENDED or new.policy in (HELD, LATCHED):
        return after
    return replace(after, early=(*after.early, node))


def with_early_cause(cell: Cell, event: life.NodeExited) -> life.NodeExited:
    """Name the node that has ended early in the exit of one that was ready."""
    ended, old = _still_ended(cell), cell.nodes.get(event.node)
    is_victim = old is not None and old.state == "ready" and event.exit.is_failure
    if not ended or not is_victim or event.will_restart or event.is_stale:
        return event
    return replace(event, exit=event.exit._replace(by=ended[0]))


def blamed_early(cell: Cell, event: life.NodeExited) -> tuple[Cell, tuple[Record, ...]]:
    """Count a node that has finished early as failed, as soon as another one fails for it."""
    node = cell.nodes.get(event.exit.by)
    if node is None or node.state != "finished":
        return cell, ()
    failed = node._replace(state="failed", exit=EARLY)
    record = Record("node-crashed", event.exit.by, EARLY.details())
    return replace(cell, nodes={**cell.nodes, event.exit.by: failed}), (record,)


def blamed_early_results(results: Mapping[str, Exit]) -> dict[str, Exit]:
    """dora's results, in which a node that others have failed for is a success."""
    causes = {how.by for how in results.values() if how.by}
    return {
        node: EARLY if node in causes and not how.is_failure else how
        for node, how in results.items()
    }


def _still_ended(cell: Cell) -> list[str]:
    return [node for node in cell.early if node in cell.nodes and cell.nodes[node].state in _ENDED]
