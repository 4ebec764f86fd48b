"""Which nodes an event has made the runner give up. Pure."""

from dora_systemd.decisions.life import node_table as table
from dora_systemd.decisions.life.handlers import is_lost, is_replaced
from dora_systemd.decisions.life.states import Cell, State


def given_up(before: Cell, after: Cell) -> dict[str, str]:
    """The nodes that have failed and stay down while the dataflow runs, each with its last end.

    before, after: the cell before and after one event. A node that dora ended because of another
    one is not given up, nor one whose version before the reload comes back.
    """
    if after.state is not State.RUNNING or after.failure or after.stop_by or after.reload:
        return {}
    spent = table.spent(after.nodes)
    return {
        ident: spent.get(ident) or str(after.nodes[ident].exit)
        for ident, old in before.nodes.items()
        if is_lost(after, ident)
        and not is_lost(before, ident)
        and not is_replaced(before, old)
        and not after.nodes[ident].exit.by
    }
