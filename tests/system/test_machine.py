"""What only a kernel with cgroup controllers can show."""

import json
import os
import re
import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.cgroup.groups import read_cpu
from dora_systemd.errors import ExitCode
from tests.system.cells import TICK, Cell, Project, is_alive, run, wait_for

LEAK = """
from dora import Node
import time
node, hoard = Node(), []
for event in node:
    if event["type"] == "INPUT":
        hoard.append(bytearray(16 << 20))
"""


# In a machine of the lab three nodes take all the CPU time there is.
ALONE = "nodes: [{id: sink, path: sink.py, inputs: {t: dora/timer/millis/100}}]"
KILLED_FOR_MEMORY = (
    r"the (supervisor process was killed, out of memory|dora \w+ is gone \(out of memory, )"
    r"|node sink: out of memory, peak \S+, limit of the dataflow \S+"
)
"""The kernel chooses what it kills first, and what lives long enough to record that."""
CHILD = """
import subprocess
subprocess.Popen(["sleep", "1000"])
"""


@pytest.mark.vm
def test_node_groups_have_controllers_and_messages_shared_memory(
    cell: Cell, project: Project
) -> None:
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
    cell.wait_exchanging()
    assert not [one for one in cell.journal() if "shm segment" in str(one["MESSAGE"])]


@pytest.mark.warns("oom", "OOM", "killed", "crashed", "node exited with error", "failed", "Failed")
@pytest.mark.warns("has used up its memory limit", "is close to a memory limit")
@pytest.mark.vm
def test_a_limit_of_the_unit_kills_the_leaking_node_alone(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", LEAK)
    cell.start(flow, "--property", "MemoryMax=700M", "--property", "MemorySwapMax=0")
    wait_for("it is degraded", lambda: cell.status.stage == "degraded", 300)
    assert re.fullmatch(
        r"out of memory, peak \S+M, limit of the dataflow 700M",
        str(cell.status.nodes["sink"].exit),
    )
    assert cell.status.nodes["source"].state == "running"
    (whole,) = cell.journal("DORA_EVENT=dataflow-oom")
    assert whole["DORA_MOST"] == "sink"
    assert int(whole["DORA_HELD"]) > 300 << 20
    assert ("node-oom", "sink") in cell.events()
    assert "out of memory" in cell.show("StatusText")
    events = run("cat", str(cell.group / "node-sink" / "memory.events")).stdout
    assert "oom_group_kill 1" in events
    found = why(cell)
    assert (found["status"], found["cause"], found["node"]) == (
        *("Degraded", "node-out-of-memory"),
        "sink",
    )
    assert (found["details"]["owner"], found["details"]["memory_limit_bytes"]) == (
        "dataflow",
        700 << 20,
    )
    text = cell.doractl("why", cell.name).stdout
    assert re.search(r"\n  Memory: +peak \S+M, limit 700M of the dataflow\n", text), text
    assert f"doractl set {cell.name} --memory-limit" in text


@pytest.mark.warns("oom", "OOM", "killed", "node exited with error", "restart", "Failed")
@pytest.mark.warns("Memory", "is close to a memory limit")
@pytest.mark.vm
def test_a_node_over_its_limit_is_killed_alone(cell: Cell, project: Project) -> None:
    """With all its processes, named with its peak and its limit, and restarted by its policy."""
    flow = project.three_nodes()
    project.write("sink.py", CHILD + LEAK)
    flow.write_text(flow.read_text() + "    restart_policy: on-failure\n    restart_delay: 2\n")
    cell.start(flow, "--node=sink:memory_limit=300M,swap_limit=0")
    before = cell.pids("node-source") + cell.pids("node-doubler")
    (event,) = wait_for("it is out of memory", lambda: cell.journal("DORA_EVENT=node-oom"), 300)
    assert (event["DORA_NODE"], event["DORA_OWNER"]) == ("sink", "node")
    assert int(event["DORA_LIMIT"]) == 300 << 20
    assert abs(int(event["DORA_LIMIT"]) - int(event["DORA_PEAK"])) < 16 << 20
    assert str(event["MESSAGE"]).endswith("out of memory, peak 300M, limit 300M")
    wait_for("it was restarted", lambda: cell.status.nodes["sink"].restarts, 60)
    assert all(is_alive(pid) for pid in before)
    assert cell.pids("node-source") + cell.pids("node-doubler") == before
    cell.wait_exchanging("source")
    assert "out of memory, peak 300M, limit 300M" in cell.doractl("list", cell.name).stdout
    (restart,) = why(cell)["restart_history"][:1]
    assert (restart["node"], restart["reason"]) == ("sink", "out of memory, peak 300M, limit 300M")
    assert not [one for one in cell.events() if one[0] == "dataflow-oom"]


HOARD = """
from dora import Node
from pathlib import Path
node, hoard = Node(), []
group = Path("/sys/fs/cgroup") / Path("/proc/self/cgroup").read_text().strip()[4:]
limit = int((group / "memory.max").read_text())
def held():
    return int((group / "memory.stat").read_text().split()[1])
while held() < 0.91 * limit:
    hoard.append(b"x" * (1 << 20))
print("full", flush=True)
for event in node:
    pass
"""


@pytest.mark.warns("is close to a memory limit")
@pytest.mark.vm
def test_memory_that_gets_short_is_reported_once(cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", HOARD)
    cell.start(flow, "--node=sink:memory_limit=600M,swap_limit=0")
    wait_for("it is full", lambda: cell.messages("sink"), 60)
    (event,) = wait_for("it is told", lambda: cell.journal("DORA_EVENT=memory-pressure"), 60)
    assert (event["DORA_NODE"], int(event["DORA_LIMIT"])) == ("sink", 600 << 20)
    samples = cell.status.samples
    wait_for("two more looks", lambda: not any(one in cell.status.samples for one in samples), 60)
    assert len(cell.journal("DORA_EVENT=memory-pressure")) == 1


LIMITED = (
    "sink:memory_limit=300M,memory_high=infinity,swap_limit=0,cpu_limit=1.5,tasks_limit=200,"
    "cpu_weight=50,io_weight=20"
)


@pytest.mark.emulator
def test_limits_are_what_the_kernel_holds_up(cell: Cell, project: Project) -> None:
    flow = slow_flow(project)
    project.write("dataflow.systemd.yml", "nodes: {source: {memory_limit: 1G}}\nmemory_high: 2G\n")
    cell.start(flow, "--memory-limit=1500M", "--cpu-limit=1.5", f"--node={LIMITED}")
    assert control(cell, ".", "memory.max") == str(1500 << 20)
    assert control(cell, ".", "memory.high") == str(2 << 30)
    assert control(cell, ".", "cpu.max") == "150000 100000"
    assert control(cell, ".", "pids.max") == "max"
    files = {"memory.max": str(300 << 20), "memory.swap.max": "0", "memory.high": "max"}
    files |= {"cpu.max": "150000 100000", "pids.max": "200", "cpu.weight": "50"}
    files |= {"io.weight": "default 20", "memory.oom.group": "1"}
    assert {name: control(cell, "node-sink", name) for name in files} == files
    assert control(cell, "node-source", "memory.max") == str(1 << 30)
    assert control(cell, "node-doubler", "memory.max") == "max"
    assert "--set=sink:cpu_limit=150%%" in cell.doractl("show", cell.name).stdout
    row = listed(cell)
    assert (row["memory_limit_bytes"], row["cpu_limit_percent"]) == (1500 << 20, 150)
    assert [one["memory_limit_bytes"] for one in row["nodes"]] == [1 << 30, None, 300 << 20]
    assert "/1.5G" in cell.doractl("list").stdout


@pytest.mark.vm
def test_limits_change_live_and_are_remembered(cell: Cell, project: Project) -> None:
    flow = slow_flow(project)
    cell.start(flow, "--enable", "--node=sink:memory_limit=1G,cpu_weight=30")
    changes = ("--memory-limit=1500M", "--node=source:tasks_limit=77")
    done = cell.doractl(
        "set", cell.status.uuid[:8], *changes, "--node=sink:cpu_limit=0.8,memory_limit=600M"
    )
    assert done.stderr == ""
    changed = [str(1500 << 20), str(600 << 20), "80000 100000", "30", "77"]
    assert held(cell) == changed
    (source,) = [one for one in listed(cell)["nodes"] if one["node"] == "source"]
    assert (source["tasks_limit"], 0 < source["tasks"] <= 77) == (77, True)
    text = cell.doractl("show", cell.name).stdout
    assert "MemoryMax=1572864000" in text
    assert "sink:cpu_limit=80%% sink:memory_limit=600M" in text
    bad = cell.doractl("set", cell.unit, "--memory-limit=2G", "--node=x:cpu_limit=1", check=False)
    assert bad.returncode == ExitCode.BAD_INPUT
    assert held(cell) == changed
    cell.doractl("stop", cell.name)
    cell.systemctl("start")
    assert held(cell) == changed
    cell.doractl("disable", cell.name)
    assert held(cell) == changed
    cell.doractl("restart", cell.name)
    assert held(cell) == changed
    check_lifted(cell)
    cell.doractl("stop", cell.name)
    assert not list(Path("/").glob(f"[er][tu][cn]/systemd/*/{cell.unit}*")), "nothing is left of it"
    cell.start(flow)
    assert held(cell)[:2] == ["max", "max"]


def check_lifted(cell: Cell) -> None:
    """All limits can be lifted while messages are exchanged."""
    lifted = "sink:cpu_limit=infinity,memory_limit=infinity"
    cell.doractl("set", cell.name, "--memory-limit=infinity", f"--node={lifted}")
    assert held(cell) == ["max", "max", "max 100000", "30", "77"]
    cell.wait_exchanging()


@pytest.mark.warns("oom", "OOM", "killed", "failed", "Failed", "Memory", "memory", "exited")
@pytest.mark.vm
def test_a_limit_that_kills_the_supervisor_process_is_named(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", ALONE)
    project.write("sink.py", "from dora import Node\nfor event in Node():\n    pass\n")
    cell.start(flow, "--memory-limit=300M")
    done = cell.doractl("set", cell.name, "--memory-limit=5M", check=False)
    words = r"cannot limit the memory of the dataflow to 5M: it uses \S+ now"
    assert re.search(words, done.stderr), done.stderr
    assert (done.returncode, control(cell, ".", "memory.max")) == (1, str(300 << 20))
    # systemd starts ExecStopPost= there: it hung in one of 60 rounds where files filled the limit.
    done = cell.doractl("set", cell.name, "--memory-limit=5M", "--force", check=False)
    least = re.search(r"hint: (\S+) or more; systemd would hang in less", done.stderr)
    assert least, done.stderr
    assert (done.returncode, control(cell, ".", "memory.max")) == (1, str(300 << 20))
    cell.doractl("set", cell.name, f"--memory-limit={least[1]}", "--force")
    wait_for("it has failed", lambda: cell.show("ActiveState") == "failed", 120)
    wait_for("the journal has it", lambda: why(cell)["cause"] != "no-end")
    found = why(cell)
    assert (found["status"], found["cause"].removeprefix("node-")) == ("Failed", "out-of-memory")
    assert re.match(KILLED_FOR_MEMORY, found["summary"]), found["summary"]
    assert f"doractl set {cell.name} --memory-limit SIZE" in found["remedies"][0]
    done = cell.doractl("set", cell.name, "--memory-limit=300M")
    assert done.stdout.startswith("Limits changed for the next start: ")
    cell.doractl("restart", cell.name)
    assert control(cell, ".", "memory.max") == str(300 << 20)


def slow_flow(project: Project) -> Path:
    """Three nodes with so few messages that a slow and limited machine keeps up."""
    flow = project.three_nodes()
    flow.write_text(flow.read_text().replace(TICK, "dora/timer/millis/500"))
    return flow


def held(cell: Cell) -> list[str]:
    """Limits that the kernel holds up."""
    return [
        control(cell, ".", "memory.max"),
        *(control(cell, "node-sink", name) for name in ("memory.max", "cpu.max", "cpu.weight")),
        control(cell, "node-source", "pids.max"),
    ]


def control(cell: Cell, group: str, name: str) -> str:
    """A control file of a group of the cell."""
    return (cell.group / group / name).read_text().strip()


LOOK = """
from dora import Node
import os
node = Node()
for device in ("/dev/fuse", "/dev/kmsg", "/dev/null"):
    try:
        os.close(os.open(device, os.O_RDWR))
        print(device, "is open", flush=True)
    except PermissionError:
        print(device, "is closed", flush=True)
for event in node:
    pass
"""


@pytest.mark.emulator
def test_devices_and_realtime(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", ALONE)
    project.write("sink.py", LOOK)
    cell.start(flow, "--uid=root", "--device=/dev/fuse", "--realtime=fifo:20")
    seen = wait_for("it looked", lambda: cell.messages("sink")[2:] and cell.messages("sink"), 60)
    assert seen == ["/dev/fuse is open", "/dev/kmsg is closed", "/dev/null is open"]
    (pid,) = cell.pids("node-sink")
    assert os.sched_getscheduler(pid) == os.SCHED_FIFO
    assert os.sched_getparam(pid).sched_priority == 20


SPIN = """
from dora import Node
node = Node()
node.next()
print("spinning", flush=True)
while True:
    pass
"""


@pytest.mark.warns("grace period", "killed on drop", "node exited with error")
@pytest.mark.vm
def test_a_busy_node_has_its_share(cell: Cell, project: Project) -> None:
    flow = project.write("dataflow.yml", ALONE)
    project.write("sink.py", SPIN)
    cell.start(flow, "--node=sink:cpu_limit=0.4", "--grace-duration=1s")
    wait_for("it spins", lambda: cell.messages("sink"), 60)
    shares: list[float] = []

    def is_held() -> bool:
        """Never more than its share; and no less, when the host lets the machine run."""
        shares.append(cpu_share(cell.group / "node-sink", 5))
        assert shares[-1] <= 0.4 * 1.05, shares
        return shares[-1] >= 0.4 * 0.95

    wait_for("it has its share", is_held, 60)
    (row,) = [one for one in listed(cell)["nodes"] if one["node"] == "sink"]
    assert row["cpu_limit_percent"] == 40
    # Each period, where nothing else keeps the machine from running.
    assert row["throttled_percent"] > 50
    (event,) = wait_for("it is told", lambda: cell.journal("DORA_EVENT=cpu-throttled"), 60)
    assert event["DORA_NODE"] == "sink"
    assert abs(row["cpu_percent"] - 40) < 5
    assert "THROTTLED%" in cell.doractl("list", cell.name).stdout


def cpu_share(group: Path, seconds: float) -> float:
    """How many processors a group uses: what is measured is a rate, hence the sleep."""
    used, began = read_cpu(group).cpu_us, time.monotonic()
    time.sleep(seconds)
    return (read_cpu(group).cpu_us - used) / (time.monotonic() - began) / 1_000_000


def why(cell: Cell) -> dict[str, Any]:
    """What `doractl why` knows of the cell."""
    found: dict[str, Any] = json.loads(cell.doractl("why", cell.name, "-o", "json").stdout)
    return found


def listed(cell: Cell) -> dict[str, Any]:
    """What `doractl list` knows of the cell."""
    row: dict[str, Any] = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)
    return row
