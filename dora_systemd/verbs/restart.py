"""`doractl restart`: restarts loaded dataflows, unless the next start would be refused.

act_on() does that for the views, which also stop dataflows.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from dora_systemd.adapters.bus.manager import JOB_DONE, Manager, Observer, StageObserver, tell_stage
from dora_systemd.adapters.host.process import beside
from dora_systemd.adapters.runner_socket.client import ask_refusal
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import is_absent
from dora_systemd.values import shown
from dora_systemd.verbs.facts.boot import lost_program
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.facts.containers import find_outside, with_left
from dora_systemd.verbs.facts.locks import uninhibited
from dora_systemd.verbs.facts.reason import job_reason, logs_hint, need_failure, runners_refusal
from dora_systemd.verbs.node import NodeOrder, order_node, socket_of
from dora_systemd.verbs.stop import THAWED, find_dependents, note_stop, stop_cells

Ask = Callable[[Path], DoraSystemdError | None]
"""The error with which the runner at a path would refuse to start again."""


def restart_cells(
    manager: Manager,
    scope: Scope,
    cells: Sequence[Cell],
    by: str,
    is_forced: bool = False,
    observer: Observer | None = None,
    ask: Ask = ask_refusal,
) -> list[Outcome]:
    """Stop and start dataflows in parallel, and wait until their nodes are ready.

    A dataflow that could not start again keeps running, unless is_forced. by: what requests the
    restart, for the journal. The restart resets the counter of automatic restarts.
    """
    thawed = {cell for cell in cells if manager.thaw(cell.unit)}  # a frozen runner answers nothing
    refused = {} if is_forced else find_refusals(manager, scope, cells, ask)
    chosen = [cell for cell in cells if cell not in refused]
    note_stop(chosen, by)
    for cell in chosen:
        manager.hold(cell.unit)  # keep a failed transient unit and its failure
        manager.reset_failed(cell.unit)
    outside = find_outside(manager, [cell.unit for cell in chosen])
    results = manager.run_jobs("RestartUnit", [cell.unit for cell in chosen], observer)
    outcomes = [
        Outcome.of_error(cell, refused[cell])
        if cell in refused
        else _outcome(manager, scope, cell, results[cell.unit], cell in thawed)
        for cell in cells
    ]
    return with_left(outcomes, outside)


def find_refusals(
    manager: Manager, scope: Scope, cells: Sequence[Cell], ask: Ask = ask_refusal
) -> Mapping[Cell, DoraSystemdError]:
    """The running dataflows that could not start again, each with the error of its start.

    A runner that does not answer is no reason to leave its dataflow as it is.
    """
    running = [cell for cell in cells if cell.has_begun]
    others = {cell: error for cell in running if (error := _seen_here(manager, scope, cell))}
    asked = [
        (cell, beside(partial(_find_refusal, scope, cell, ask)))
        for cell in running
        if cell not in others
    ]
    return others | {cell: error for cell, answer in asked if (error := answer.result())}


def _seen_here(manager: Manager, scope: Scope, cell: Cell) -> DoraSystemdError | None:
    """The error of a start that the runner of the dataflow does not know."""
    facts = manager.read(cell.unit, ["ExecStart", "LoadCredential"])
    return (
        lost_program(manager, scope, cell, facts["ExecStart"], "restart")
        or _other_version(cell)
        or _lost_credential(cell, facts["LoadCredential"] or ())
    )


def _other_version(cell: Cell) -> DoraSystemdError | None:
    """The error for options that the installed runner would refuse; its own accepts them."""
    if not (cell.has_options and cell.options_problem):
        return None
    message = f"cannot restart {cell.name}: another version of dora-systemd has started it"
    hint = f"{cell.name} keeps running; doractl list {cell.name} says how to start this version"
    return bad_input(message, hint)


def _lost_credential(cell: Cell, given: Iterable[tuple[str, str]]) -> DoraSystemdError | None:
    """The error for a credential whose file is not there any more: systemd reads it at a start."""
    for name, file in given:
        if file.startswith("/") and is_absent(file):
            message = f"cannot use {shown(file)} as credential {name}: there is no such file"
            return _kept(cell, bad_input(message, "put it back"))
    return None


def require_startable(manager: Manager, scope: Scope, cell: Cell, ask: Ask = ask_refusal) -> None:
    """Raise the error that a start of a running dataflow would end with."""
    for error in find_refusals(manager, scope, [cell], ask).values():
        raise error


def _find_refusal(scope: Scope, cell: Cell, ask: Ask) -> DoraSystemdError | None:
    try:
        error = ask(socket_of(scope, cell))
    except DoraSystemdError:
        return None
    return error and _kept(cell, error)


def _kept(cell: Cell, error: DoraSystemdError) -> DoraSystemdError:
    """The error, with what has become of the dataflow in its hint."""
    goes_on = f"{cell.name} keeps running; doractl restart --force {cell.name} restarts it anyway"
    hint = f"{error.hint}, ".replace("?,", "?") if error.hint else ""
    return DoraSystemdError(error.message, f"{hint}{goes_on}", error.code)


def _outcome(manager: Manager, scope: Scope, cell: Cell, result: str, was_frozen: bool) -> Outcome:
    if result == JOB_DONE:
        note = f": {THAWED}" if was_frozen else ""
        return Outcome(cell, f"Dataflow restarted: {cell.uuid} ({cell.name}){note}")
    if result == "dependency":
        needed = manager.read(cell.unit, ["Requires"])["Requires"] or ()
        reason, more = need_failure(manager, scope.flag, needed)
        hint = f"{more} shows more"
    elif refusal := runners_refusal(manager, cell.unit):
        return Outcome.of_error(cell, refusal)
    else:
        reason = job_reason(manager, cell.unit, result)
        hint = logs_hint(scope.flag, cell.name, reason)
    return Outcome(cell, "", f"cannot restart {cell.name}: {reason}", hint=hint)


def act_on(
    manager: Manager,
    scope: Scope,
    cell: Cell,
    node: str,
    action: str,
    *,
    by: str,
    on_stage: StageObserver | None = None,
) -> str:
    """Stop or restart a dataflow, or one of its nodes; what was done, in one line.

    node: "" is the whole dataflow. action: "stop" or "restart". by: the view, for the journal.
    on_stage: called with each stage of a dataflow. Raises DoraSystemdError as the verbs of doractl
    do.
    """
    refuse_parts([cell], action)
    if node:
        return order_node(scope, cell, NodeOrder(action, node, by))
    observer = partial(tell_stage, on_stage)
    cells = [cell, *find_dependents(manager, [cell])]
    if action == "stop":
        note_stop(cells, by)
        outcomes = stop_cells(manager, scope, cells, observer)
    else:
        with uninhibited(scope, cells, "restart"):
            outcomes = restart_cells(manager, scope, cells, by, observer=observer)
    return "; ".join(map(told, outcomes))


def told(outcome: Outcome) -> str:
    """Return the text of an outcome. Raises DoraSystemdError for a problem."""
    if outcome.problem:
        hint = outcome.hint or f"doractl why {outcome.subject.name}"
        raise DoraSystemdError(outcome.problem, hint, outcome.code)
    return outcome.text
