"""Stops or restarts one dataflow or one node, for the views in which a person chooses it."""

from functools import partial

from dora_systemd.adapters.bus.manager import StageObserver, tell_stage
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import restart_node, stop_node
from dora_systemd.verbs.stop import note_stop, restart_cells, stop_cells


def act_on(
    scope: Scope,
    dataflow: str,
    node: str,
    action: str,
    *,
    by: str,
    on_stage: StageObserver | None = None,
) -> str:
    """Stop or restart a dataflow, or one of its nodes; what was done, in one line.

    dataflow: its UUID. node: "" is the whole dataflow. action: "stop" or "restart". by: the view,
    for the journal. on_stage: called with each stage of a dataflow. Raises DoraSystemdError as the
    verbs of doractl do.
    """
    bus = Bus(scope)
    cell = Selector(dataflow).find(bus)
    if node:
        do = stop_node if action == "stop" else restart_node
        do(scope, cell, node)
        return f"Node {node} of {cell.name}: {action} begun"
    observer = partial(tell_stage, on_stage)
    if action == "stop":
        note_stop([cell], by)
        (outcome,) = stop_cells(bus, scope, [cell], observer)
    else:
        (outcome,) = restart_cells(bus, [cell], observer)
    if outcome.problem:
        raise DoraSystemdError(outcome.problem, f"doractl why {cell.name}")
    return outcome.text
