"""Rows of `list` from a fake systemd, a fake cgroup tree and a node table."""

import time
from pathlib import Path
from typing import Any

import pytest

from dora_systemd import cgroup, managerlist
from dora_systemd.managercells import read_cells
from dora_systemd.managerlist import dataflow_row, find_row, read_rows
from dora_systemd.scope import Scope
from dora_systemd.status import CellStatus, CpuSample, NodeStatus
from dora_systemd.statuswords import DataflowRow
from tests.unit.fake_manager import FakeManager, ScopeIn, options

GROUP = "/dora.slice/dora-robot.service"
SECOND = 1_000_000


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")


@pytest.fixture
def unit_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cgroup tree with one node that used 2 s of CPU and 1 MiB, and an empty RuntimeDirectory."""
    monkeypatch.setattr(cgroup, "mount_point", lambda: tmp_path / "cgroup")
    group = tmp_path / "cgroup" / GROUP[1:]
    node = group / "node-camera"
    node.mkdir(parents=True)
    for place, cpu, memory in ((group, 4 * SECOND, 3 << 20), (node, 2 * SECOND, 1 << 20)):
        (place / "cpu.stat").write_text(f"usage_usec {cpu}\n")
        (place / "memory.current").write_text(f"{memory}\n")
        (place / "cgroup.events").write_text("populated 1\n")
    return group


def row_of(manager: FakeManager, scope: Scope) -> DataflowRow:
    return dataflow_row(manager, scope, read_cells(manager)[0])


def now_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000


def write_status(scope: Scope, status: CellStatus) -> None:
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    (directory / "status.json").write_text(status.to_json())


@pytest.mark.usefixtures("unit_group")
def test_running_dataflow(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(
        options(),
        ControlGroup=GROUP,
        NRestarts=1,
        ActiveEnterTimestampMonotonic=now_us() - 90 * SECOND,
        ActiveEnterTimestamp=17,
    )
    sample = CpuSample(now_us() - 4 * SECOND, {"": 2 * SECOND, "camera": SECOND})
    nodes = {
        "camera": NodeStatus("running", 42, restarts=2),
        "plot": NodeStatus("failed", exit="exit code 1"),
    }
    write_status(scope, CellStatus(stage="degraded", nodes=nodes, samples=(sample,)))
    row = row_of(manager, scope)
    assert (row.status, row.restarts, row.nodes_alive, row.nodes_total) == ("Degraded", 3, 1, 2)
    assert row.uptime is not None
    assert 90 * SECOND <= row.uptime < 95 * SECOND
    assert row.cpu_percent == pytest.approx(50, rel=0.2)
    assert row.memory == 3 << 20
    camera, plot = row.nodes
    assert (camera.pid, camera.memory, camera.state) == (42, 1 << 20, "running")
    assert camera.cpu_percent == pytest.approx(25, rel=0.2)
    assert (plot.exit, plot.memory, plot.cpu_percent) == ("exit code 1", None, None)


@pytest.mark.parametrize("group", [GROUP, "/other.slice/dora-robot.service"])
@pytest.mark.parametrize("active", ["active", "activating", "failed"])
@pytest.mark.parametrize("has_samples", [True, False])
def test_the_table_asks_for_less_and_says_the_same(
    scope: Scope, unit_group: Path, group: str, active: str, has_samples: bool
) -> None:
    if group != GROUP:
        unit_group.parent.rename(unit_group.parents[1] / "other.slice")
    manager = FakeManager()
    started = now_us() - 40 * SECOND
    times = {"InactiveExitTimestampMonotonic": started}
    times["ActiveEnterTimestampMonotonic"] = started + (SECOND if active == "active" else -SECOND)
    manager.add(options(), active=active, ControlGroup=group, NRestarts=1, **times)
    samples = (CpuSample(now_us() - 4 * SECOND, {"": 2 * SECOND}),) if has_samples else ()
    status = CellStatus(nodes={"camera": NodeStatus("running", 42)}, samples=samples)
    write_status(scope, status)
    (all_of_it,) = read_rows(manager, scope)
    (line,) = read_rows(manager, scope, with_details=False)
    assert (line.memory is None) == (active == "failed")
    now: dict[str, Any] = {"uptime": None, "cpu_percent": None, "nodes": ()}
    assert line._replace(**now) == all_of_it._replace(**now)
    for mine, other in ((line.uptime, all_of_it.uptime), (line.cpu_percent, all_of_it.cpu_percent)):
        assert mine == (other and pytest.approx(other, rel=0.1))


@pytest.mark.usefixtures("unit_group")
def test_node_table_that_cannot_be_read(scope: Scope) -> None:
    """Another user's: the cgroups still tell which nodes there are."""
    manager = FakeManager()
    since = now_us() - 40 * SECOND
    manager.add(
        options(),
        ControlGroup=GROUP,
        InactiveExitTimestampMonotonic=since,
        ActiveEnterTimestampMonotonic=since,
    )
    row = row_of(manager, scope)
    assert (row.status, row.nodes_alive, row.nodes_total) == ("Running", 1, 1)
    assert row.cpu_percent == pytest.approx(10, rel=0.2)
    assert row.nodes[0].state == "unknown"


@pytest.mark.usefixtures("unit_group")
@pytest.mark.parametrize("text", ["", "{", "[]", '{"nodes": 3}', "\udcff"])
def test_damaged_node_table(scope: Scope, text: str) -> None:
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    (directory / "status.json").write_bytes(text.encode(errors="surrogateescape"))
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    assert row_of(manager, scope).status == "Running"


@pytest.mark.usefixtures("unit_group")
def test_starting_dataflow(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(
        options(),
        active="activating",
        ControlGroup=GROUP,
        InactiveExitTimestampMonotonic=now_us() - 3 * SECOND,
    )
    row = row_of(manager, scope)
    assert row.status == "Starting"
    assert row.started == 0
    assert row.uptime is not None
    assert 3 * SECOND <= row.uptime < 5 * SECOND


def test_failed_dataflow(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(options(), active="failed", StatusText="node camera failed")
    row = row_of(manager, scope)
    assert (row.status, row.text, row.uptime) == ("Failed", "node camera failed", None)


def test_a_row_is_found_by_selector(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(options(), active="failed")
    assert find_row(manager, scope, "robot").name == "robot"
    assert managerlist.read_status(scope, read_cells(manager)[0]) == CellStatus()
