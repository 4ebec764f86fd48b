"""How long a stop may take, and how much of it each part gets. Times in µs.

0 ............. 1.5 grace ....... + 2 ........ + 4 ........... + 9 ............ + 10
dora ends the nodes  its answer   the daemon   journald takes  the runner has   systemd
                                  leaves       what is left    exited           kills
"""

from dora_systemd.values import INFINITY, SECOND

STOP_MARGIN = 10 * SECOND
"""What TimeoutStopSec= allows beyond 1.5 grace durations, dora's own last resort."""
RESERVE = SECOND
"""The runner is gone so long before systemd kills it: systemd's clock began to run first."""
LEAVE_TIMEOUT = 2 * SECOND


def stop_timeout(grace: int) -> int:
    """Until a Stop without an answer is given up: dora kills after 1.5 times the grace."""
    return grace + grace // 2 + 2 * SECOND


def unit_timeout(grace: int) -> int:
    """TimeoutStopSec= of the unit."""
    return INFINITY if grace == INFINITY else grace + grace // 2 + STOP_MARGIN


def runner_timeout(grace: int) -> int:
    """Until the runner has exited."""
    return INFINITY if grace == INFINITY else unit_timeout(grace) - RESERVE
