"""What nodes owe: outputs on which a message has to come in time, and what happens if none does.

The setting is in decisions/settings/owes.py.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from dora_systemd.decisions.cell.extra import PROBE, check_ids
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import DEFAULT, RestartPolicy, given_policies, with_values
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.values import INFINITY, SECOND, format_duration, parse_duration, quoted

RESTART, WARN, FAIL = "restart", "warn", "fail"
THEN = (RESTART, WARN, FAIL)
STARVED = ", starved of "
"""The text before the input, NODE/OUTPUT, that a silent node lacks; `why` parses it."""
KEYS = ("output", "within", "first", "then")

SHORTEST = SECOND // 5
"""The shortest `within`, in µs: the runner checks several times within that time."""
FIRST = 30 * SECOND
"""µs; the default of `first`, unless `within` is longer."""

_FORM = "OUTPUT:within=TIME,first=TIME,then=restart|warn|fail"
_HINT = f"write {_FORM}; within is required"


class Owed(NamedTuple):
    """One output that a node owes. Times in µs."""

    node: str  # "" if the context determines the node
    output: str
    within: int  # between two messages
    first: int = FIRST  # from the start of the node to its first message
    then: str = RESTART  # one of THEN

    @property
    def place(self) -> str:
        """The output as in the inputs of a descriptor, NODE/OUTPUT."""
        return f"{self.node}/{self.output}"


def parse_owed(text: str) -> Owed:
    """The exact inverse of format_owed; `first` and `then` may be left out.

    Raises DoraSystemdError (USAGE).
    """
    output, colon, rest = text.rpartition(":")
    pairs = [part.partition("=") for part in rest.split(",")]
    if not (colon and output and all(equals for _, equals, _ in pairs)):
        raise _wrong(f"{quoted(text)} is none", _HINT)
    return owed_of({"output": output, **{key.strip(): value for key, _, value in pairs}})


def format_owed(owed: Owed) -> str:
    """Format without the node: `image:within=2s,first=30s,then=restart`."""
    within, first = format_duration(owed.within), format_duration(owed.first)
    return f"{owed.output}:within={within},first={first},then={owed.then}"


def owed_of(values: Mapping[str, str]) -> Owed:
    """The output from its KEYS as texts. Raises DoraSystemdError (USAGE)."""
    for key in values:
        if key not in KEYS:
            hint = did_you_mean(key, KEYS) or f"valid keys: {', '.join(KEYS)}"
            raise _wrong(f"unknown key {quoted(key)}", hint)
    output, then = values.get("output", "").strip(), values.get("then", RESTART).strip()
    if not output or not output.isprintable():
        raise _wrong("it names no output", "write output: NAME, one of the node's outputs")
    if "within" not in values:
        raise _wrong(f"it does not say within which time {output} has to come", "write within: 2s")
    if then not in THEN:
        hint = did_you_mean(then, THEN) or f"valid values: {', '.join(THEN)}"
        raise _wrong(f"unknown action {quoted(then)}", hint)
    within = _time("within", values["within"])
    first = _time("first", values["first"]) if "first" in values else max(FIRST, within)
    return Owed("", output, within, first, then)


def _time(key: str, text: str) -> int:
    hint = f"write a time with its unit such as 500ms or 2s, at least {format_duration(SHORTEST)}"
    try:
        time = parse_duration(text)
    except DoraSystemdError as error:
        raise _wrong(f"{key} is {quoted(text)}", hint) from error
    # systemd reads a bare number as seconds, other programs as milliseconds: here it is neither.
    if text.strip()[-1:].isdigit() or not SHORTEST <= time < INFINITY:
        raise _wrong(f"{key} is {quoted(text)}", hint)
    return time


def _wrong(reason: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot read an owed output: {reason}", hint)


def distinct(owes: Iterable[Owed]) -> tuple[Owed, ...]:
    """The owed outputs of a node; of several for the same output the last one counts."""
    return tuple({one.output: one for one in owes}.values())


@lru_cache(maxsize=4)
def owes_of(options: RunnerOptions) -> tuple[Owed, ...]:
    """The outputs that nodes owe. Raises DoraSystemdError."""
    owes = options.by_node("owes")
    return tuple(one._replace(node=node) for node, own in owes.items() for one in own)


def base_of(policy: RestartPolicy, owes: Iterable[Owed], node: str) -> RestartPolicy:
    """The policy of a node without one of its own, from that of the dataflow."""
    if policy.policy != "no" or not any(one.node == node and one.then == RESTART for one in owes):
        return policy
    return policy._replace(policy="on-failure")


@lru_cache(maxsize=4)
def policies_of(options: RunnerOptions) -> Mapping[str, RestartPolicy]:
    """The policies of single nodes. Raises DoraSystemdError."""
    given, owes = given_policies(options), owes_of(options)
    base = with_values(DEFAULT, given.pop("", {}))
    return {node: with_values(base_of(base, owes, node), own, node) for node, own in given.items()}


_OTHER = "write then: warn or then: fail"
_NEVER_RESTARTED = {
    NodeKind.OPERATOR: "dora does not restart nodes made of operators",
    NodeKind.DYNAMIC: "dora does not start it",
}


def check_owes(
    owes: Sequence[Owed], restarts: Mapping[str, RestartPolicy], nodes: Sequence[Node]
) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for an output that no node has, or no restart is possible.

    restarts: policies of single nodes. nodes: with modules expanded.
    """
    if not owes:
        return
    by_id = {node.id: node for node in nodes}
    for one in owes:
        node = by_id[one.node]
        _check_output(one, node)
        if one.then == RESTART and (reason := _no_restart(node, restarts.get(node.id))):
            hint = f"{_OTHER}, or another restart_policy"
            hint = _OTHER if node.kind in _NEVER_RESTARTED else hint
            raise bad_input(f"cannot restart the silent node {quoted(one.node)}: {reason}", hint)
    check_ids("watch outputs", PROBE, by_id)


def _check_output(owed: Owed, node: Node) -> None:
    # ros2 nodes get outputs from their topics.
    if node.kind is NodeKind.ROS2 or owed.output in node.outputs:
        return
    outputs = sorted(node.outputs)
    message = f"cannot watch {quoted(owed.output)} of the node {quoted(node.id)}: no such output"
    known = f"outputs: {', '.join(outputs)}" if outputs else "the node has no outputs"
    raise bad_input(message, did_you_mean(owed.output, outputs) or known)


def _no_restart(node: Node, own: RestartPolicy | None) -> str:
    """Return why dora would not restart the node, or ""."""
    if node.kind in _NEVER_RESTARTED:
        return _NEVER_RESTARTED[node.kind]
    is_never = node.restart_policy == "never" if own is None else own.policy == "no"
    return "it is never restarted, says its restart_policy" if is_never else ""
