"""Tells an end of a node that somebody has asked for from a crash. Pure.

NodeAsked of events.py says that a restart or a stop of a node was asked for, before it is done. The
live table keeps that, and whatever counts, shows or judges an end asks was_asked() or is_stopped().
"""

from collections.abc import Mapping

from dora_systemd.decisions.cell.status import NodeStatus

RESTART, STOP = "restart", "stop"


def was_asked(node: NodeStatus) -> bool:
    """Whether an end of the node's process is what somebody has asked for.

    A restart covers the process that it ends, and not the next one: that can crash.
    """
    return is_stopped(node) or (node.asked == RESTART and node.state == "reloading")


def is_stopped(node: NodeStatus) -> bool:
    """Whether somebody has stopped the node, and nobody has started it again."""
    return node.asked == STOP


def is_stopping(node: NodeStatus) -> bool:
    """Whether a node that somebody has stopped has still a process, other than its launcher."""
    return is_stopped(node) and bool(node.pid) and not node.is_held


def format_stopped(stopped: Mapping[str, str]) -> str:
    """As "plot, requested by root (doractl node stop)"; "" if nobody has stopped a node.

    stopped: by node, who has asked for its stop, or "".
    """
    by = dict.fromkeys(filter(None, stopped.values()))
    parts = (
        (", ".join(node for node, one in stopped.items() if one == who), format_asked(who))
        for who in by
    )
    return "; ".join(f"{nodes}, {asked}" for nodes, asked in parts)


def format_asked(by: str) -> str:
    """Who has asked, as in "requested by root (doractl node stop)"."""
    return f"requested by {by}"
