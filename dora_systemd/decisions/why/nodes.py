"""The nodes of an ended dataflow, from its life events: the runner's table is gone. Pure."""

from dora_systemd.decisions.cell.asked import STOP
from dora_systemd.decisions.views.facts import NodeRow
from dora_systemd.decisions.why.lives import Happening, Life

_STATES = {
    "node-ready": "running",
    "node-restarted": "starting",
    "node-crashed": "failed",
    "node-ended": "failed",
    "node-oom": "failed",
    "node-exited": "finished",
    "node-asked": "stopped",
}
_WITH_PROCESS = ("running", "starting")


def ended_nodes(life: Life) -> tuple[NodeRow, ...]:
    """The nodes that the events of a life name, in the states in which its end left them."""
    rows: dict[str, NodeRow] = {}
    is_stopping = False
    for one in life.happenings:
        is_stopping |= one.name == "dataflow-stopping"
        is_news = one.name != "node-asked" or one.detail("asked") == STOP
        if one.node and one.name in _STATES and is_news:
            row = rows.get(one.node, NodeRow(one.node, "", restarts=0))
            rows[one.node] = _after(row, one, is_stopping)
    end = life.last("dataflow-failed")
    # Nodes that never became ready, or that another one took along, have no event of their own.
    for node in end.detail("nodes").split() if end else ():
        rows[node] = rows.get(node, NodeRow(node, "", restarts=0))._replace(state="failed")
    return tuple(_closed(row, life) for row in rows.values())


def _after(row: NodeRow, event: Happening, is_stopping: bool) -> NodeRow:
    state, is_end = _STATES[event.name], event.name == "node-exited"
    return row._replace(
        state="stopped" if is_end and (is_stopping or event.detail("asked") == STOP) else state,
        restarts=(row.restarts or 0) + (event.name == "node-restarted"),
        exit=row.exit if state in _WITH_PROCESS else event.detail("exit"),
        since=event.at_us,
    )


def _closed(row: NodeRow, life: Life) -> NodeRow:
    """systemd leaves no process behind, whatever the last event of the node was."""
    if row.state not in _WITH_PROCESS:
        return row
    return row._replace(state="stopped", since=life.happenings[-1].at_us)
