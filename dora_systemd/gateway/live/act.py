"""The actions of the status page's buttons, and the data of its graph of a dataflow."""

from contextlib import suppress
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.gateway.page_messages import PageMessage, graph_values
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.act import act_on
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.nodes import written_dataflow
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import ask_coordinator

_BY = "status page"


def act(scope: Scope, message: PageMessage) -> str:
    """Stop or restart a dataflow, or one of its nodes; what was done, for the page.

    Raises DoraSystemdError as the verbs of doractl do.
    """
    return act_on(scope, message.dataflow, message.node, message.action, by=_BY)


def read_graph(scope: Scope, uuid: str) -> dict[str, Any]:
    """Nodes and edges of a dataflow. Raises DoraSystemdError if there is no readable descriptor.

    dora's own copy is what runs, with modules expanded; the file may have changed since the start.
    """
    cell = Selector(uuid).find(Bus(scope))
    path = cell.options.dataflow
    running = _running_descriptor(scope, cell)
    return graph_values(parse_dataflow(running, path) if running else written_dataflow(path))


def _running_descriptor(scope: Scope, cell: Cell) -> object:
    """dora's copy, or None if no run has one."""
    run = read_status(scope, cell).run if cell.is_up else ""
    # The dataflow may be ending at this moment.
    with suppress(DoraSystemdError, KeyError, TypeError):
        if run:
            reply = ask_coordinator(scope, cell, {"Info": {"dataflow_uuid": run}})
            if isinstance(reply.result, dict) and not reply.error:
                return reply.result["DataflowInfo"]["descriptor"]
    return None
