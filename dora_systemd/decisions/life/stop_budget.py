"""How long a stop may take, and how much of it each part gets. Times in µs.

0 ............. 1.5 grace ....... + 2 ........ + 4 ........... + 9 ............ + 10
dora ends the nodes  its answer   the daemon   journald takes  the runner has   systemd
                                  leaves       what is left    exited           kills
"""

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.values import INFINITY, SECOND

STOP_MARGIN = 10 * SECOND
"""What TimeoutStopSec= allows beyond 1.5 grace durations, when dora kills the nodes.

With a setting `stop` of a node, the nodes have `stop_limit` in the place of that.
"""
ANSWER_MARGIN = 2 * SECOND
"""For the answer of dora, or for what ends the last node."""
RESERVE = SECOND
"""The runner exits this long before systemd kills it, because systemd's timer started first."""
LEAVE_TIMEOUT = 2 * SECOND
ANSWER_TIMEOUT = 150 * SECOND
"""For the answer of a runner that may stop nodes and wait until others are ready; the time in which
the nodes stop is added."""
_LONGEST = 24 * 3600 * SECOND
"""A grace duration can be infinite, but nobody waits longer for an answer."""


def kill_delay(grace: int) -> int:
    """Return the time after which dora kills a node that does not stop."""
    return grace + grace // 2


def stop_timeout(grace: int) -> int:
    """Timeout of dora's Stop."""
    return kill_delay(grace) + ANSWER_MARGIN


def nodes_timeout(options: RunnerOptions) -> int:
    """The time after which the last node is killed."""
    if options.has("stop"):
        limit: int = options.of_dataflow("stop_limit")
        return limit
    return kill_delay(options.grace)


def answer_timeout(options: RunnerOptions) -> int:
    """Timeout for the answer to a reload, restart or stop of nodes."""
    return ANSWER_TIMEOUT + min(nodes_timeout(options), _LONGEST)


def unit_timeout(options: RunnerOptions) -> int:
    """TimeoutStopSec= of the unit."""
    return min(nodes_timeout(options) + STOP_MARGIN, INFINITY)


def runner_timeout(options: RunnerOptions) -> int:
    """The time for the runner to exit."""
    timeout = unit_timeout(options)
    return INFINITY if timeout == INFINITY else timeout - RESERVE
