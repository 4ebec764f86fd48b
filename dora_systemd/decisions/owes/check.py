"""Checks what nodes owe against the descriptor, before anything starts."""

from collections.abc import Sequence

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import RESTART, Owed, is_probe
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import check_known, did_you_mean
from dora_systemd.values import quoted

_OTHER = "write then: warn or then: fail"
_NEVER_RESTARTED = {
    NodeKind.OPERATOR: "dora does not restart nodes made of operators",
    NodeKind.DYNAMIC: "dora does not start it",
}


def check_owes(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for an output that no node has, or no restart is possible.

    nodes: with modules expanded.
    """
    if not options.owes:
        return
    by_id = {node.id: node for node in nodes}
    check_known("cannot watch the outputs of", (one.node for one in options.owes), by_id)
    for one in options.owes:
        _check_output(one, by_id[one.node])
        if one.then == RESTART and (reason := _no_restart(by_id[one.node], options)):
            hint = f"{_OTHER}, or another restart_policy"
            if by_id[one.node].kind in _NEVER_RESTARTED:
                hint = _OTHER
            raise _refusal(f"cannot restart the silent node {quoted(one.node)}: {reason}", hint)
    for node in filter(is_probe, by_id):
        message = f"cannot watch outputs: the node {quoted(node)} has a name that doractl needs"
        raise _refusal(message, "give that node another id")


def _check_output(owed: Owed, node: Node) -> None:
    # ros2 nodes get outputs from their topics.
    if node.kind is NodeKind.ROS2 or owed.output in node.outputs:
        return
    outputs = sorted(node.outputs)
    message = f"cannot watch {quoted(owed.output)} of the node {quoted(node.id)}: no such output"
    known = f"outputs: {', '.join(outputs)}" if outputs else "the node has no outputs"
    raise _refusal(message, did_you_mean(owed.output, outputs) or known)


def _no_restart(node: Node, options: RunnerOptions) -> str:
    """Why dora would not restart the node, or ""."""
    if node.kind in _NEVER_RESTARTED:
        return _NEVER_RESTARTED[node.kind]
    own = dict(options.node_restarts).get(node.id)
    is_never = node.restart_policy == "never" if own is None else own.policy == "no"
    return "it is never restarted, says its restart_policy" if is_never else ""


def _refusal(message: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(message, hint, ExitCode.BAD_INPUT)
