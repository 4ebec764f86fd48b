"""Which nodes have a notify socket, and the time within which each must send a WATCHDOG=1.

The terms are those of WatchdogSec= in systemd.service(5) and of sd_notify(3).
"""

from collections.abc import Container, Mapping

from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.values import INFINITY, SECOND, parse_duration, quoted

ALL_NODES = ""
SHORTEST = SECOND // 5
"""µs. The runner looks eight times as often, and must not notice that."""
OFF = 0
"""The node has no notify socket."""
HINT = "write a time with its unit such as 5s, at least 200ms; or infinity for no watchdog"

Watchdogs = Mapping[str, int]
"""µs by node, with ALL_NODES for the others; INFINITY: a notify socket without a watchdog."""

NO_WATCHDOGS: Watchdogs = {}


def parse_watchdog(text: str) -> int:
    """The time in µs, INFINITY for none; raises DoraSystemdError (USAGE).

    Unlike in WatchdogSec=, a number has a unit: 500 could be meant in milliseconds.
    """
    try:
        limit = parse_duration(text)
    except DoraSystemdError as error:
        raise _refusal(text) from error
    if limit < SHORTEST or text.strip()[-1:].isdigit():
        raise _refusal(text)
    return limit


def merge_watchdogs(limits: Watchdogs, sockets: Mapping[str, bool]) -> dict[str, int]:
    """The time of each node that has a socket. sockets: whether one without a watchdog has."""
    everywhere = limits.get(ALL_NODES, INFINITY), sockets.get(ALL_NODES, False)
    found = {
        node: _socket(limits.get(node, everywhere[0]), sockets.get(node, everywhere[1]))
        for node in dict.fromkeys((ALL_NODES, *limits, *sockets))
    }
    usual = found.pop(ALL_NODES)
    others = {node: limit for node, limit in found.items() if limit != usual}
    return {ALL_NODES: usual, **others} if usual else others


def _socket(limit: int, is_wanted: bool) -> int:
    return limit if limit < INFINITY or is_wanted else OFF


def watchdog_of(watchdogs: Watchdogs, node: str) -> int:
    """µs of one node, INFINITY for a socket alone, OFF for neither."""
    return watchdogs.get(node, watchdogs.get(ALL_NODES, OFF))


def check_watchdogs(watchdogs: Watchdogs, launched: Container[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that is not in `launched`.

    launched: nodes that get their environment from our launcher.
    """
    for node, limit in watchdogs.items():
        if node and limit and node not in launched:
            message = f"cannot give the node {node} a notify socket: dora itself starts it"
            hint = (
                "operators, dynamic nodes and nodes of ROS 2 or with path_sha256 have none, so no"
                " watchdog, notify or stop: within either"
            )
            raise bad_input(message, hint)


def _refusal(text: str) -> DoraSystemdError:
    return usage_error(f"cannot use {quoted(text)} as watchdog", HINT)
