"""From the command to the last process gone, and a restart.  `python -m benchmarks.stop [N]`"""

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

from benchmarks.contestants import ALL, Contestant, prepared
from benchmarks.flows import clear_stamps, make_home, wait_gone, wait_stamps, write_flow
from benchmarks.rounds import EMPTY, Figure, alternate, keep

COUNT = 2


def is_running(contestant: Contestant) -> list[int]:
    """Start it and wait until messages flow; the pids of the nodes."""
    clear_stamps()
    contestant.start()
    wait_stamps("input", COUNT - 1)
    return [stamp.pid for stamp in wait_stamps("ready", COUNT)]


def stop_ms(contestant: Contestant) -> float:
    """Until the command has returned and no node is left."""
    pids = is_running(contestant)
    begun = time.monotonic()
    contestant.stop()
    wait_gone(pids)
    return (time.monotonic() - begun) * 1000


def restart_ms(contestant: Contestant) -> float:
    """Until the new nodes exchange messages."""
    return resumed_ms(contestant, is_running(contestant), contestant.restart)


def resumed_ms(contestant: Contestant, old: Sequence[int], act: Callable[[], None]) -> float:
    """From `act`, which ends the nodes `old`, until the next ones exchange messages."""
    clear_stamps()
    begun = time.monotonic()
    act()
    fresh = wait_stamps("input", COUNT - 1)
    contestant.stop()
    wait_gone([*old, *(stamp.pid for stamp in fresh)])
    return (max(stamp.at for stamp in fresh) - begun) * 1000


def measure(rounds: int) -> list[Figure]:
    """Both, of two Python nodes."""
    flow = write_flow(make_home(), COUNT)
    with prepared(ALL, flow) as contestants:
        for one in contestants:
            stop_ms(one)  # warm
        stops = {one.name: partial(stop_ms, one) for one in contestants}
        restarts = {one.name: partial(restart_ms, one) for one in contestants}
        return [
            alternate("stop until nothing is left", "ms", stops, rounds, goal=f"≤ 9 {EMPTY}"),
            alternate("restart until messages flow", "ms", restarts, rounds, goal=f"≤ 33 {EMPTY}"),
        ]


if __name__ == "__main__":
    keep("stop", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)
