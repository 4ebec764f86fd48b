"""How a cell fails: entries of TABLE in table.py, and what all of its entries are made of."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.states import Action, Cell, Deadline, Do, Record, RunnerExit, State
from dora_systemd.decisions.resources.oom import Owner
from dora_systemd.values import SECOND

Step = tuple[Cell, tuple[Action, ...]]
Handler = Callable[[Cell, life.Event], Step]

ENGINE_TIMEOUT = 30 * SECOND
"""What dora itself allows its parts to answer each other."""


def to(cell: Cell, state: State, *actions: Action, after: int | None = None) -> Step:
    """Change the state. after: µs until DeadlinePassed, or None."""
    return replace(cell, state=state), (*actions, Deadline(after))


def refused(cell: Cell, event: life.Event) -> Step:
    """Dora does not want it, or does not understand us."""
    assert isinstance(event, life.Refused)
    return fail(because(cell, event.cause), event.reason, RunnerExit.FAILED)


def because(cell: Cell, cause: Cause, nodes: Iterable[str] = ()) -> Cell:
    """Note why the cell is about to fail, and which nodes it is about."""
    return replace(cell, cause=cause, culprits=tuple(nodes))


def broken(cell: Cell, event: life.Event) -> Step:
    """The runner could not do its part: whatever is left to do, the cell ends now."""
    assert isinstance(event, life.Failed)
    cell = replace(cell, reload=False)
    if cell.failure:
        return fail(cell, cell.failure, cell.exit)  # that came first
    reason = f"the runner could not {event.what}: {event.error}"
    return fail(because(cell, Cause.RUNNER_BROKEN), reason, RunnerExit.FAILED)


def fail(cell: Cell, reason: str, code: RunnerExit) -> Step:
    """End at once, and say why."""
    cell = replace(cell, failure=reason, exit=code)
    is_trial = cell.is_trial and not cell.ready_us and not cell.stop_by
    name = "reload-failed" if is_trial else "dataflow-failed"
    details = {"reason": reason, "cause": str(cell.cause), "nodes": " ".join(cell.culprits)}
    known = {key: text for key, text in details.items() if text}
    return to(cell, State.ENDED, Record(name, "", known), Do.EXIT)


def child_exited(cell: Cell, event: life.Event) -> Step:
    """Without coordinator or daemon there is no dataflow."""
    assert isinstance(event, life.ChildExited)
    reason = f"the dora {event.child} is gone ({event.exit})"
    cell, actions = _lose(cell, event.child, reason, event.exit)
    return cell, (*oom_of_all(event), *actions)


def connection_lost(cell: Cell, event: life.Event) -> Step:
    """The same, learned another way."""
    assert isinstance(event, life.ConnectionLost)
    return _lose(cell, event.child, event.reason, "")


def _lose(cell: Cell, child: str, reason: str, how: str) -> Step:
    cell = because(cell, Cause(f"{child}-lost"))
    cell, actions = fail(cell, reason, RunnerExit.ENGINE_LOST)
    return cell, (Record(f"{child}-lost", "", {"exit": how} if how else {}), *actions)


def engine_deadline(cell: Cell, event: life.Event) -> Step:  # noqa: ARG001 - as all handlers
    """Dora does not answer."""
    reason = f"dora did not answer within {ENGINE_TIMEOUT // SECOND} s while {cell.state.value}"
    return fail(because(cell, Cause.NO_ANSWER), reason, RunnerExit.ENGINE_LOST)


def oom_of_all(event: life.Event) -> tuple[Action, ...]:
    """What there is to say about the dataflow when its own limit has killed something of it."""
    if not isinstance(event, life.NodeExited | life.ChildExited) or event.oom is None:
        return ()
    if event.oom.owner is not Owner.DATAFLOW:
        return ()
    return (Record("dataflow-oom", "", event.oom.dataflow_details()),)
