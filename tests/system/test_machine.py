"""What only a kernel with cgroup controllers can show."""

import pytest

from tests.system.cells import Cell, Project, run, wait_for

pytestmark = pytest.mark.vm

LEAK = """
from dora import Node
import time
node, hoard = Node(), []
for event in node:
    if event["type"] == "INPUT":
        hoard.append(bytearray(16 << 20))
"""


def test_node_groups_have_controllers(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    for node in ("source", "doubler", "sink"):
        group = cell.group / f"node-{node}"
        assert {"cpu", "memory", "pids"} <= set((group / "cgroup.controllers").read_text().split())
        assert int((group / "memory.current").read_text()) > 0
    rows = cell.doractl("list", cell.name).stdout
    assert "PEAK" in rows
    assert not [
        line for line in rows.splitlines() if line.startswith("sink") and " - " in line[:50]
    ]


def test_messages_go_through_shared_memory(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    cell.wait_exchanging()
    assert not [one for one in cell.journal() if "shm segment" in str(one["MESSAGE"])]


@pytest.mark.warns("oom", "OOM", "killed", "crashed", "node exited with error", "failed", "Failed")
def test_a_limit_of_the_unit_kills_the_leaking_node_alone(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", LEAK)
    cell.start(flow, "--property", "MemoryMax=700M", "--property", "MemorySwapMax=0")
    wait_for("it is degraded", lambda: cell.status.stage == "degraded", 300)
    assert cell.status.nodes["sink"].exit == "signal SIGKILL"
    assert cell.status.nodes["source"].state == "running"
    events = run("cat", str(cell.group / "node-sink" / "memory.events")).stdout
    assert "oom_kill 1" in events
