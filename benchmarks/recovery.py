"""`kill -9` of what runs the nodes, until messages flow again.  `python -m benchmarks.recovery [N]`

Bare dora is not here: after the loss of its daemon nothing comes back.
"""

import os
import signal
import sys
from functools import partial

from benchmarks.contestants import (
    Circus,
    Contestant,
    Doractl,
    Pm2,
    Supervisord,
    SystemdRun,
    prepared,
)
from benchmarks.flows import make_home, write_flow
from benchmarks.rounds import EMPTY, OURS, Figure, alternate, keep
from benchmarks.stop import COUNT, is_running, resumed_ms


class AtOnce(Doractl):
    """Ours with a restart that waits for nothing."""

    more = ("--restart-delay", "0")


def recovery_ms(contestant: Contestant) -> float:
    """Until the next nodes exchange messages; delays that supervisors wait first are within."""
    old = is_running(contestant)
    return resumed_ms(contestant, old, partial(os.kill, contestant.main_pid(), signal.SIGKILL))


def measure(rounds: int) -> list[Figure]:
    """Two Python nodes; ours also without a delay, beside the one that has none."""
    flow, what = write_flow(make_home(), COUNT), "kill -9 until messages flow again"
    with prepared((Doractl, SystemdRun, Supervisord, Circus, Pm2), flow) as contestants:
        measures = {one.name: partial(recovery_ms, one) for one in contestants}
        at_once = {OURS: partial(recovery_ms, AtOnce(flow)), Pm2.name: measures[Pm2.name]}
        for warm_up in [*measures.values(), at_once[OURS]]:
            warm_up()
        goal = f"the delay of 500 ms, and ≤ 12 {EMPTY}"
        return [
            alternate(what, "ms", measures, rounds, goal=goal),
            alternate(f"{what}, `restart_delay: 0`", "ms", at_once, rounds, goal=f"≤ 25 {EMPTY}"),
        ]


if __name__ == "__main__":
    keep("recovery", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)
