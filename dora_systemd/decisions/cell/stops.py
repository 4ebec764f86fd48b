"""How single nodes stop: the time of each, and which nodes stop before it.

The setting is in decisions/settings/stops.py.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import check_known, did_you_mean, is_node_id
from dora_systemd.values import INFINITY, format_duration, parse_duration, quoted

KEYS = ("within", "after")
_HINT = "write {within: 60s, after: [NODE]}, or one of the two"


class NodeStop(NamedTuple):
    """The stop of one node."""

    node: str
    within: int = 0  # µs until SIGTERM, 0 for the grace duration of the dataflow
    after: tuple[str, ...] = ()  # the nodes that end before this one receives its stop


Stops = Mapping[str, NodeStop]
"""By node."""


def named_stops(stops: Mapping[str, NodeStop]) -> Stops:
    """The stops, with the node in each."""
    return {node: stop._replace(node=node) for node, stop in stops.items()}


def parse_node_stop(text: str) -> NodeStop:
    """The exact inverse of format_node_stop. Raises DoraSystemdError (USAGE)."""
    pairs = (part.partition("=") for part in text.split(",") if part)
    values = {key: value for key, _, value in pairs}
    return stop_of({**values, "after": values.get("after", "").split()})


def format_node_stop(stop: NodeStop) -> str:
    """Format without the node: `within=1min,after=camera arm`."""
    within = [f"within={format_duration(stop.within)}"] if stop.within else []
    after = [f"after={' '.join(stop.after)}"] if stop.after else []
    return ",".join([*within, *after])


def stop_of(values: Mapping[str, str | Sequence[str]]) -> NodeStop:
    """The stop of a node from its KEYS. Raises DoraSystemdError (USAGE)."""
    for key in values:
        if key not in KEYS:
            hint = did_you_mean(key, KEYS) or f"valid keys: {', '.join(KEYS)}"
            raise _wrong(f"unknown key {quoted(key)}", hint)
    within, after = values.get("within"), values.get("after", ())
    names = (after,) if isinstance(after, str) else tuple(after)
    for name in names:
        if not is_node_id(name):
            raise _wrong(f"{quoted(name)} is no node", "write after: [NODE, ...]")
    if within is None and not names:
        raise _wrong("it has neither within nor after", _HINT)
    time = 0 if within is None else _time(str(within))
    return NodeStop("", time, tuple(dict.fromkeys(names)))


def _time(text: str) -> int:
    hint = "write a time with its unit, such as 60s"
    try:
        time = parse_duration(text)
    except DoraSystemdError as error:
        raise _wrong(f"within is {quoted(text)}", hint) from error
    # systemd reads a bare number as seconds, other programs as milliseconds: here it is neither.
    if text.strip()[-1:].isdigit() or not 0 < time < INFINITY:
        raise _wrong(f"within is {quoted(text)}", hint)
    return time


def _wrong(reason: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot read the stop of a node: {reason}", hint)


def within_of(stops: Stops, node: str, grace: int) -> int:
    """µs until SIGTERM for `node`. grace: of the dataflow."""
    stop = stops.get(node)
    return stop.within if stop and stop.within else grace


def kill_time(within: int, grace: int) -> int:
    """µs until SIGKILL: half a grace duration after SIGTERM, as dora does it."""
    return within + grace // 2


def tails(stops: Stops, grace: int) -> dict[str, int]:
    """µs that all later nodes take, by node, if each of them is killed.

    There must be no circle.
    """
    later: dict[str, list[str]] = {}
    for one in stops.values():
        for name in one.after:
            later.setdefault(name, []).append(one.node)
    found: dict[str, int] = {}
    for node in reversed(_in_order(stops)):
        rows = (_longest(stops, grace, next) + found[next] for next in later.get(node, ()))
        found[node] = max(rows, default=0)
    return found


def _in_order(stops: Stops) -> list[str]:
    """The nodes, each behind those that stop before it. Raises CycleError."""
    return list(TopologicalSorter({one.node: one.after for one in stops.values()}).static_order())


def _longest(stops: Stops, grace: int, node: str) -> int:
    return kill_time(within_of(stops, node, grace), grace)


def total(stops: Stops, grace: int) -> int:
    """µs that the stop of a dataflow takes at most, if no node gets more time."""
    rows = (_longest(stops, grace, node) + tail for node, tail in tails(stops, grace).items())
    return max([kill_time(grace, grace), *rows])


def check_stops(stops: Collection[NodeStop], limit: int, grace: int, nodes: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a stop that no dataflow of these `nodes` can have.

    limit: µs for the whole stop.
    """
    if not stops:
        return
    known, by_node = list(nodes), {one.node: one for one in stops}
    for one in stops:
        check_known(f"cannot stop {one.node} after", one.after, known)
    _check_order(by_node)
    _check_time(by_node, limit, grace)


def _check_order(stops: Stops) -> None:
    try:
        _in_order(stops)
    except CycleError as error:
        circle = " after ".join(reversed(error.args[1]))
        message = f"cannot stop {circle}: that is a circle"
        raise bad_input(message, "remove one of them from stop: after:") from error


def _check_time(stops: Stops, limit: int, grace: int) -> None:
    time = total(stops, grace)
    if time <= limit:
        return
    slowest = max(stops, key=lambda node: within_of(stops, node, grace))
    needs = "infinity" if time >= INFINITY else format_duration(time)
    message = (
        f"cannot give the node {slowest} {format_duration(stops[slowest].within or grace)} to stop:"
        f" a stop would take {needs}, and stop_limit is {format_duration(limit)}"
    )
    raise bad_input(message, "raise stop_limit, or lower stop: within: or grace_duration")
