"""What a runner does while its dataflow does nothing, by the switches that the kernel counts."""

import re
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, wait_for

IDLE = """
from dora import Node
for event in Node():
    pass
"""
PLAIN = "nodes: [{id: idle, path: idle.py, inputs: {tick: dora/timer/secs/100}}]"
BY_DORA = """nodes:
  - id: idle
    path: idle.py
    inputs: {tick: dora/timer/secs/100}
    outputs: [said]
    send_stdout_as: said
"""
APART_US = 10_000_000
MOST = 8
"""Waits of all threads from one tick to the next: for the tick, an answer of dora and the watchdog,
and a few for Python's own lock."""
_VOLUNTARY = re.compile(r"^voluntary_ctxt_switches:\s*(\d+)$", re.MULTILINE)


def waits(pid: int) -> int:
    """How often a thread of the process has begun to wait, see proc_pid_status(5)."""
    statuses = (path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/status"))
    return sum(int(one) for text in statuses for one in _VOLUNTARY.findall(text))


def times(cell: Cell) -> list[int]:
    return [one.at_us for one in cell.status.samples]


def is_at_rest(cell: Cell) -> bool:
    found = times(cell)
    return len(found) > 1 and found[-1] - found[-2] > APART_US


@pytest.mark.parametrize(
    ("flow", "settings"),
    [(PLAIN, "{}"), (BY_DORA, "{}"), (PLAIN, "nodes: {idle: {needs: [/dev/null]}}")],
    ids=["plain", "by-dora", "needs"],
)
def test_an_idle_dataflow(cell: Cell, project: Project, flow: str, settings: str) -> None:
    """It wakes its runner at the ticks only."""
    project.write("idle.py", IDLE)
    project.write("dataflow.systemd.yml", settings)
    cell.start(project.write("dataflow.yml", flow))
    runner = cell.supervisor_pid("runner")

    def is_woken_by_the_tick_only() -> bool:
        before, last = waits(runner), times(cell)[-1:]
        wait_for("the next sample", lambda: times(cell)[-1:] != last, 60)
        found = waits(runner) - before
        print(last, times(cell), found)
        return is_at_rest(cell) and found <= MOST

    # A machine that is busy may write a line, or take CPU time for pages, in one of the periods.
    wait_for("a period at rest", is_woken_by_the_tick_only, 120)
