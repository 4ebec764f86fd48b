"""50 dataflows that do nothing, and 20 that start at once.  `python -m benchmarks.fleet [N]`

At a boot systemd starts all enabled units in one transaction, and `systemctl start` of all of them
does so here. The rival is a unit with `dora run` for each dataflow, written by hand.
"""

import sys
import time
from functools import partial
from pathlib import Path

from benchmarks.contestants import ENVIRONMENT
from benchmarks.cost import cpu_seconds
from benchmarks.crowd import Crowd, crowd
from benchmarks.flows import STAMPS, clear_stamps, make_home, wait_stamps, write_flow
from benchmarks.rounds import OURS, Figure, Measure, alternate, keep, shown
from tests.system.cells import Cell, run
from tests.system.test_idle import waits

IDLE, AT_BOOT = 50, 20
COUNT = 2
"""Nodes of each that starts."""
SETTLE_SECONDS = 40.0
WINDOW_SECONDS = 60.0
UNITS = Path("/run/systemd/system")
BY_HAND = """[Service]
ExecStart=/opt/lab/bin/dora run {flow}
Environment=VIRTUAL_ENV={VIRTUAL_ENV} PATH={PATH}
KillMode=mixed
Restart=always
"""


def idle_figures(all_of_them: Crowd, rounds: int) -> list[Figure]:
    """Of a runner, on average, in windows in which nothing happens."""
    all_of_them.grow_ours(IDLE)
    time.sleep(SETTLE_SECONDS)
    pids = [cell.supervisor_pid("runner") for cell in all_of_them.cells]
    waked, used = list[float](), list[float]()
    for _ in range(rounds):
        before = sum(map(waits, pids)), sum(map(cpu_seconds, pids))
        time.sleep(WINDOW_SECONDS)
        waked.append((sum(map(waits, pids)) - before[0]) / IDLE * 60 / WINDOW_SECONDS)
        seconds = sum(map(cpu_seconds, pids)) - before[1]
        used.append(100 * seconds / IDLE / WINDOW_SECONDS)
    what = f"of a runner, of {IDLE} that are idle"
    return [
        shown(Figure(f"wakeups a minute {what}", "1/min", {OURS: waked}, "0")),
        shown(Figure(f"CPU {what}", "%", {OURS: used}, "≤ 0.01 %")),
    ]


def boot_seconds(units: list[str]) -> float:
    """From the request until all nodes are ready, and a stop behind the clock."""
    clear_stamps()
    begun = time.monotonic()
    run("systemctl", "start", "--no-block", *units)
    ready = wait_stamps("ready", COUNT * len(units))
    run("systemctl", "stop", *units)
    return max(stamp.at for stamp in ready) - begun


def enabled_units(flow: Path) -> list[str]:
    """Ours, which write their stamps through the sandbox."""
    cells = [Cell(f"boot-{number}") for number in range(AT_BOOT)]
    for cell in cells:
        cell.start(flow, "--writable", str(STAMPS), "--restart-policy", "always")
        run("doractl", "enable", cell.name)
        run("doractl", "stop", cell.name)
    return [cell.unit for cell in cells]


def units_by_hand(flow: Path) -> list[str]:
    """One `dora run` each."""
    units = [f"by-hand-{number}.service" for number in range(AT_BOOT)]
    for unit in units:
        (UNITS / unit).write_text(BY_HAND.format(flow=flow, **ENVIRONMENT))
    run("systemctl", "daemon-reload")
    return units


def boot_figure(flow: Path, rounds: int) -> Figure:
    """Ours and units by hand in turns."""
    ours, others = enabled_units(flow), units_by_hand(flow)
    measures: dict[str, Measure] = {
        OURS: partial(boot_seconds, ours),
        "units by hand, dora run": partial(boot_seconds, others),
    }
    for warm_up in measures.values():
        warm_up()
    what = f"{AT_BOOT} dataflows in one transaction, until all nodes are ready"
    figure = alternate(what, "s", measures, rounds, goal="≤ 1.2 × units by hand")
    run("doractl", "disable", *ours)
    return figure


def measure(rounds: int) -> list[Figure]:
    """Both."""
    project = make_home()
    figures = [boot_figure(write_flow(project, COUNT), rounds)]
    with crowd(project) as everyone:
        return [*figures, *idle_figures(everyone, max(rounds // 2, 1))]


if __name__ == "__main__":
    keep("fleet", measure, int(sys.argv[1]) if len(sys.argv) > 1 else 5)
