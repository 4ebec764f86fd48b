"""How long the command itself takes.  `python -m benchmarks.startup [N]`"""

import sys
import time
from collections.abc import Callable
from functools import partial

from benchmarks.contestants import (
    RIVALS,
    Circus,
    Contestant,
    Doractl,
    DoraUp,
    Pm2,
    Supervisord,
    prepared,
)
from benchmarks.flows import HOME, make_home, write_flow
from benchmarks.rounds import EMPTY, OURS, Figure, Measure, alternate, keep
from tests.system.cells import run

VERSIONS = {
    OURS: ("doractl", "--version"),
    "dora": ("dora", "--version"),
    "systemctl": ("systemctl", "--version"),
    "supervisorctl": (f"{RIVALS}/supervisord", "--version"),
    "circusctl": (f"{RIVALS}/circusctl", "--version"),
    "pm2": ("env", f"PM2_HOME={HOME}/pm2", f"{RIVALS}/pm2", "--version"),
    "python3, nothing": ("python3", "-c", ""),
}


def timed(command: Callable[[], object]) -> float:
    """ms of a call."""
    begun = time.monotonic()
    command()
    return (time.monotonic() - begun) * 1000


def listings(contestants: list[Contestant]) -> dict[str, Measure]:
    """The commands that list what runs, of those and of systemctl."""
    commands: dict[str, Callable[[], object]] = {OURS: partial(run, "doractl", "list")}
    pattern = "dora-*.service"
    commands["systemctl"] = partial(run, "systemctl", "--no-pager", "list-units", pattern)
    for one in contestants:
        match one:
            case DoraUp():
                commands["dora"] = partial(one.dora, "list")
            case Supervisord():
                commands["supervisorctl"] = partial(one.control, "status")
            case Circus():
                commands["circusctl"] = partial(one.control, "status")
            case Pm2():
                commands["pm2"] = partial(one.control, "list")
    return {name: partial(timed, command) for name, command in commands.items()}


def measure(rounds: int) -> list[Figure]:
    """The version, and a list of nothing, or of the one program that is known."""
    flow = write_flow(make_home(), 2)
    with prepared((Doractl, DoraUp, Supervisord, Circus, Pm2), flow) as contestants:
        commands = {name: partial(run, *words) for name, words in VERSIONS.items()}
        versions: dict[str, Measure] = {
            name: partial(timed, command) for name, command in commands.items()
        }
        lists = listings(contestants)
        for warm_up in [*versions.values(), *lists.values()]:
            warm_up()
        return [
            alternate("`--version`", "ms", versions, rounds),
            alternate("`list` with no dataflow", "ms", lists, rounds, goal=f"≤ 2.5 {EMPTY}"),
        ]


if __name__ == "__main__":
    keep("startup", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 20)
