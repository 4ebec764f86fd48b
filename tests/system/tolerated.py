"""What dora, zenoh and systemd say, now and then, of nothing but the lab's machine and its speed.

No test asks for these lines and no test fails because of one. Every other warning in the journal of
our units fails the test that it comes up in, unless that test announces it.
"""

from typing import NamedTuple


class Word(NamedTuple):
    """Part of a warning. reason: why it says nothing about us. dora: the version it was seen in.

    is_all: nothing else is in the warning, which may be short then.
    """

    part: str
    reason: str
    dora: str = "1.1.0"
    is_all: bool = False

    def is_in(self, line: str) -> bool:
        """Whether a line, `SOURCE: WARNING`, says it."""
        return line.endswith(f": {self.part}") if self.is_all else self.part in line


_ORDER = "a node opens zenoh before its peers do, or outlives them by milliseconds"
_SLOW = "a node or the daemon got no processor for a while"
_NO_CONTROLLERS = "systemd 262 reads a limit of groups that have none in the lab's container"
_ENDING = "one end of a connection within the cell was closed a moment before the other"

TOLERATED = (
    Word("timeout while waiting for event stream thread", _SLOW),  # of a node that ends
    Word("Scouting delay elapsed before start conditions are met", _ORDER),
    Word("Unable to find transport for link event", _ORDER),
    Word("Error syncing transport with peer", _ORDER),
    Word("Unable to connect to ", _ORDER),  # a locator, any of them, a newly scouted peer
    Word("in response to an OpenSyn", _ORDER),
    # zenoh's router, when a peer takes back what this node has never heard of.
    Word("Unknown subscriber", _ORDER),
    Word("Unknown interest", _ORDER),
    Word("Unknown token", _ORDER, is_all=True),
    Word("Unknown wire expr", _ORDER, is_all=True),
    Word("Unknown id", _ORDER, is_all=True),  # of a queryable
    Word("Route data with unknown scope", _ORDER),
    Word("[Gossip] Received LinkStateList from unknown link", _ORDER),
    Word("Attempt to establish transport to itself", _ORDER),
    Word("no heartbeat message from machine", _SLOW),  # for 15 s, by the coordinator
    Word("zenoh teardown timed out", _SLOW),
    Word("Discarding event for input", _SLOW),
    Word("ms for handling event", _SLOW),
    Word("Didn't receive final reply for query", _SLOW),
    Word("eply: Query not found!", _SLOW),
    Word("for unknown Query", _SLOW),
    Word("for unknown Request", _SLOW),
    Word("event channel full", _SLOW),
    Word("event channel low on capacity", _SLOW),
    Word("closing node connection after I/O error", _ENDING),
    Word("server disconnected unexpectedly", _ENDING),
    Word("failed to report outputs done to dora-daemon", _ENDING),
    Word("failed to close outputs on drop", _ENDING),
    Word("failed to send metrics for dataflow: WS send channel closed", _ENDING),
    # The coordinator, when a machine that has no node left ends its part before the stop is sent.
    Word("failed to send/receive stop message: WS daemon send channel closed", _ENDING),
    # A session that closes forgets the keys first, and may still get a query or data with one.
    Word("for unknown key_expr: Remote resource ", _ENDING),
    Word("dropping event because event `tx` was already closed", _ENDING),
    Word(
        "failed to notify daemon of peer disconnect: WS daemon send channel closed",
        "two daemons of a dataflow left the coordinator at nearly the same time",
    ),
    Word(
        "all daemons disconnected - entering reclaim window",
        "the daemons of all machines left a coordinator that was about to end as well",
    ),
    Word(
        "failed to stop dataflow: no running dataflow with ID",
        "the nodes of one machine had ended before dora's stop came to its daemon",
    ),
    # Its other reasons, that a node restarts or crashed, have events of their own in the journal.
    Word(
        "node has no daemon event stream (it may still be starting up",
        "a node still sends to one that has just taken its stop, or has not subscribed yet",
    ),
    Word(
        "ignoring stale ProcessHandleReplaced event",
        "a node was started once more before the daemon took the process of the start before",
    ),
    Word("Timer event for unknown dataflow", "the daemon starts timers before it notes the run"),
    Word(
        "control request failed: unknown dataflow",
        "all nodes had ended before the request to stop came to the coordinator",
    ),
    Word(
        "Unable to create POSIX shm segment",
        "the lab's root may not raise limits, and nodes lock 8 MiB of shared memory or more",
    ),
    Word("Failed to read pids.max for control group", _NO_CONTROLLERS),
)


def is_tolerated(line: str) -> bool:
    """Whether a warning is one of them."""
    return any(word.is_in(line) for word in TOLERATED)
