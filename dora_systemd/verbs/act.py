"""Stops or restarts one dataflow or one node, for the views in which a person chooses it."""

from functools import partial

from dora_systemd.adapters.bus.manager import Manager, StageObserver, tell_stage
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.inhibit.guard import uninhibited
from dora_systemd.verbs.needs.dependents import find_dependents
from dora_systemd.verbs.node import NodeOrder, order_node
from dora_systemd.verbs.restart import restart_cells
from dora_systemd.verbs.stop import note_stop, stop_cells


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
    """What was done. Raises DoraSystemdError for a problem."""
    if outcome.problem:
        hint = outcome.hint or f"doractl why {outcome.subject.name}"
        raise DoraSystemdError(outcome.problem, hint, outcome.code)
    return outcome.text
