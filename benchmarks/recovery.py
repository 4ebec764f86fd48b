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
from benchmarks.rounds import Figure, alternate, keep
from benchmarks.stop import COUNT, is_running, resumed_ms


def recovery_ms(contestant: Contestant) -> float:
    """Until the next nodes exchange messages; delays that supervisors wait first are within."""
    old = is_running(contestant)
    return resumed_ms(contestant, old, partial(os.kill, contestant.main_pid(), signal.SIGKILL))


def measure(rounds: int) -> list[Figure]:
    """Two Python nodes."""
    flow = write_flow(make_home(), COUNT)
    with prepared((Doractl, SystemdRun, Supervisord, Circus, Pm2), flow) as contestants:
        measures = {one.name: partial(recovery_ms, one) for one in contestants}
        for warm_up in measures.values():
            warm_up()
        what = "kill -9 until messages flow again"
        return [alternate(what, "ms", measures, rounds, goal="≤ 1.7 s, delay of 0.5 s included")]


if __name__ == "__main__":
    keep("recovery", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 7)
