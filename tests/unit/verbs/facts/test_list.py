"""Rows of `list` from a fake systemd, a fake cgroup tree and a node table."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dora_systemd import __version__
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.extra import RECORDER
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.resources.usage import CpuSample
from dora_systemd.decisions.views.dataflows import format_dataflows
from dora_systemd.decisions.views.details import format_dataflow
from dora_systemd.decisions.views.prometheus import format_metrics
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.top import Look, TopEntry, format_top
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.files import MAX_TABLE, read_table
from dora_systemd.verbs import why
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import dataflow_row, read_rows, table_rows
from dora_systemd.verbs.facts.reading import read_dataflow, read_status
from dora_systemd.verbs.list import find_row
from dora_systemd.verbs.stop import stop_cells
from dora_systemd.verbs.top import read_snapshot
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

GROUP = "/dora.slice/dora-robot.service"
SECOND = 1_000_000


def table_of(manager: FakeManager, scope: Scope) -> list[DataflowRow]:
    """The rows of the table of `list`."""
    return table_rows(manager, scope, read_cells(manager))


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")


@pytest.fixture
def unit_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cgroup tree with one node that used 2 s of CPU and 1 MiB, and an empty RuntimeDirectory."""
    group = fake_cgroups(monkeypatch, tmp_path) / GROUP[1:]
    node = group / "node-camera"
    node.mkdir(parents=True)
    for place, cpu, memory in ((group, 4 * SECOND, 3 << 20), (node, 2 * SECOND, 1 << 20)):
        (place / "cpu.stat").write_text(f"usage_usec {cpu}\n")
        (place / "memory.current").write_text(f"{memory}\n")
        (place / "cgroup.events").write_text("populated 1\n")
    (node / "pids.current").write_text("9\n")
    (node / "pids.max").write_text("50\n")
    return group


def row_of(manager: FakeManager, scope: Scope) -> DataflowRow:
    return dataflow_row(manager, scope, read_cells(manager)[0])


def now_us() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000


def write_status(scope: Scope, status: CellStatus, name: str = "robot") -> None:
    directory = scope.cell_directory(name)
    directory.mkdir(parents=True)
    (directory / "status.json").write_text(status.to_json())


@pytest.mark.usefixtures("unit_group")
def test_a_dataflow_of_another_version_says_so(scope: Scope) -> None:
    manager = FakeManager()
    unit = manager.add(options(), ControlGroup=GROUP)
    write_status(scope, CellStatus(UUID, stage="running"))
    assert row_of(manager, scope).upgrade == ("", "")
    table = scope.cell_directory("robot") / "status.json"
    table.write_text(CellStatus(UUID, stage="running", version="0.0.9").to_json())
    (row,) = table_of(manager, scope)
    line = f"Version:  runs 0.0.9, {__version__} is installed: doractl restart robot"
    assert line in format_dataflow(row)
    command = manager.units[unit]["ExecStart"][0][1]
    command.insert(-1, "--colour=red")
    (row,) = read_rows(manager, scope)
    assert row.status == "Running"
    assert "another version has started it" in format_dataflow(row)
    assert "unknown argument '--colour=red': doractl stop robot, then" in format_dataflow(row)
    (cell,) = read_cells(manager)
    (outcome,) = stop_cells(manager, scope, [cell])
    assert outcome.text == f"Dataflow stopped: {UUID} (robot)"
    manager.units[unit] |= {"ActiveState": "inactive", "SubState": "dead"}
    assert (row.is_up, row_of(manager, scope).is_up) == (True, False)
    _, todo = row._replace(is_up=False, enabled=True).upgrade
    assert todo == f"doractl start --enable --name robot {row.dataflow}", "there is nothing to stop"


@pytest.mark.parametrize(
    ("before", "shown"),
    [
        (NodeStatus("stopped", 42, asked="stop"), ("stopping", 42)),
        (NodeStatus("stopped", 0, asked="stop"), ("stopped", 0)),
        (NodeStatus("stopped", 42, asked="stop", is_held=True), ("stopped", 0)),
        (NodeStatus("stopped", 42), ("stopped", 42)),
    ],
    ids=["its process ends", "ended", "its launcher waits", "with the dataflow"],
)
@pytest.mark.usefixtures("unit_group")
def test_a_node_is_stopped_when_its_process_has_ended(
    scope: Scope, before: NodeStatus, shown: tuple[str, int]
) -> None:
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    write_status(scope, CellStatus(nodes={"camera": before}))
    (camera,) = row_of(manager, scope).nodes
    assert (camera.state, camera.pid) == shown


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
        "plot": NodeStatus("failed", exit=exit_of(1)),
    }
    write_status(scope, CellStatus(stage="degraded", nodes=nodes, samples=(sample,)))
    row = row_of(manager, scope)
    assert (row.status, row.restarts, row.nodes_alive, row.nodes_total) == ("Degraded", 1, 1, 2)
    assert row.uptime is not None
    assert 90 * SECOND <= row.uptime < 95 * SECOND
    assert row.cpu_percent == pytest.approx(50, rel=0.2)
    assert row.memory == 3 << 20
    camera, plot = row.nodes
    assert (camera.pid, camera.memory, camera.state) == (42, 1 << 20, "running")
    assert camera.cpu_percent == pytest.approx(25, rel=0.2)
    assert (camera.tasks, camera.tasks_limit) == (9, 50)
    assert (plot.exit, plot.memory, plot.cpu_percent) == ("exit code 1", None, None)


def test_a_frozen_dataflow(scope: Scope, unit_group: Path) -> None:
    (unit_group / "cgroup.events").write_text("populated 1\nfrozen 1\n")
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    write_status(scope, CellStatus(nodes={"camera": NodeStatus("running", 42)}))
    (line,) = table_of(manager, scope)
    assert (row_of(manager, scope).status, line.status) == ("Frozen", "Frozen")


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
    started_us = {"ExecMainStartTimestamp": 7, "ActiveEnterTimestamp": 9}
    manager.add(options(), active=active, ControlGroup=group, NRestarts=1, **times, **started_us)
    samples = (CpuSample(now_us() - 4 * SECOND, {"": 2 * SECOND}),) if has_samples else ()
    status = CellStatus(nodes={"camera": NodeStatus("running", 42)}, samples=samples)
    write_status(scope, status)
    (all_of_it,) = read_rows(manager, scope)
    (line,) = table_of(manager, scope)
    assert (line.memory is None) == (active == "failed")
    now: dict[str, Any] = {"uptime": None, "cpu_percent": None, "nodes": (), "dataflow": ""}
    is_up, is_ready = active != "failed", active == "active"
    assert (all_of_it.started, all_of_it.ready) == (7 * is_up, 9 * is_ready)
    now |= {"started": 0, "ready": 0}
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


def test_the_recorder_is_no_node_for_other_users(scope: Scope, unit_group: Path) -> None:
    recorder = unit_group / f"node-{RECORDER}"
    recorder.mkdir()
    (recorder / "cgroup.events").write_text("populated 1\n")
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    row = row_of(manager, scope)
    assert ([one.node for one in row.nodes], row.nodes_alive) == (["camera"], 1)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: path.write_text(""),
    "no JSON": lambda path: path.write_text("{"),
    "no object": lambda path: path.write_text("[]"),
    "no nodes": lambda path: path.write_text('{"nodes": 3}'),
    "no UTF-8": lambda path: path.write_bytes(b"\xff"),
    "Infinity": lambda path: path.write_text('{"samples": [{"at_us": Infinity}]}'),
    "deep": lambda path: path.write_text("[" * 100_000),
    "huge": lambda path: path.write_bytes(b" " * (MAX_TABLE + 1)),
    "ESC in an id": lambda path: path.write_text('{"nodes": {"a\\u001b]0;x": {}}}'),
    "a FIFO": os.mkfifo,
    "a directory": Path.mkdir,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a circle": lambda path: path.symlink_to(path),
}


@pytest.mark.usefixtures("unit_group")
@pytest.mark.parametrize("what", DAMAGE)
@pytest.mark.parametrize("read", [read_rows, table_of])
def test_damaged_node_table(
    scope: Scope, what: str, read: Callable[[FakeManager, Scope], list[DataflowRow]]
) -> None:
    """It is a word in its own row, and the others are shown."""
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    DAMAGE[what](directory / "status.json")
    manager = FakeManager()
    now = now_us()
    times: dict[str, Any] = {
        "InactiveExitTimestampMonotonic": now,
        "ActiveEnterTimestampMonotonic": now,
    }
    manager.add(options(), ControlGroup=GROUP, **times)
    manager.add(options("other", UUID[:-1] + "1"), ControlGroup=GROUP, **times)
    other, row = read(manager, scope)
    assert (row.status, bool(row.problem)) == ("Running", True)
    assert (other.status, other.problem) == ("Running", "")
    assert " ?  " in format_dataflows([row])
    assert row.problem in format_dataflow(row)
    assert " ?  " in format_top(Look(now, [TopEntry(row)]), "cpu")
    assert format_metrics(read_snapshot(manager, scope), "1").count("dora_dataflow_info{") == 2
    facts = why.explain(manager, scope, "robot", NoJournal())  # type: ignore[arg-type]
    assert facts.verdict.now == row.problem


class NoJournal:
    """A journal without any record."""

    def newest(self, *_words: object, **_more: object) -> Iterator[dict[str, Any]]:
        return iter(())


def test_a_table_of_a_stranger_is_not_believed(scope: Scope) -> None:
    """The RuntimeDirectory is one user's, the file in it another's: somebody put it there."""
    if os.geteuid():
        pytest.skip("only root can make files of others")
    directory = scope.cell_directory("robot")
    write_status(scope, CellStatus(nodes={"a": NodeStatus()}))
    os.chown(directory, 1000, 1000)
    os.chown(directory / "status.json", 1001, 1001)
    with pytest.raises(DoraSystemdError, match="not of the user whose dataflow it is"):
        read_table(directory)
    os.chown(directory / "status.json", 1000, 1000)
    assert read_table(directory) is not None


def test_a_secret_behind_a_link_is_not_read(scope: Scope, tmp_path: Path) -> None:
    """Root would read it, and the parser's words would tell what is in it."""
    if os.geteuid():
        pytest.skip("links are refused to root alone")
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    os.chown(directory, 1000, 1000)
    (tmp_path / "secret").write_text(CellStatus(nodes={"a": NodeStatus()}).to_json())
    (directory / "status.json").symlink_to(tmp_path / "secret")
    with pytest.raises(DoraSystemdError, match="symbolic link"):
        read_table(directory)


@pytest.mark.usefixtures("unit_group")
def test_a_table_that_is_not_there_yet_is_no_problem(scope: Scope) -> None:
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    assert row_of(manager, scope).problem == ""


def test_groups_that_the_nodes_user_has_made(scope: Scope, unit_group: Path) -> None:
    for name in ("node-\x1b]0;x\a", "node-a\nb", "node-", "node-.x", "node-" + "x" * 201, "other"):
        (unit_group / name).mkdir()
    for count in range(cgroup.MAX_GROUPS + 10):
        (unit_group / f"node-{count:05}").mkdir()
    found = cgroup.shown_groups(unit_group)
    assert len(found) == cgroup.MAX_GROUPS
    assert all(node.isdigit() for node in found)
    assert list(cgroup.shown_groups(unit_group, ["camera", "gone"])) == ["camera"]
    manager = FakeManager()
    manager.add(options(), ControlGroup=GROUP)
    write_status(scope, CellStatus(nodes={"camera": NodeStatus("running")}))
    reading = read_dataflow(manager, scope, read_cells(manager)[0])
    assert list(reading.usage) == ["", "camera"]


def test_groups_that_are_nested_deeply(tmp_path: Path) -> None:
    groups = [tmp_path / "/".join("a" * depth) for depth in range(1, 1100)]
    for group in groups:
        group.mkdir()
    (groups[-1] / "cgroup.procs").write_text(f"{os.getpid()}\n")
    try:
        found = cgroup.pids(tmp_path)
        memory = cgroup.read_usage(tmp_path).memory
    finally:
        (groups[-1] / "cgroup.procs").unlink()
        for group in reversed(groups):  # pytest's own way to remove them is recursive
            group.rmdir()
    assert found == [os.getpid()]
    assert memory == 0  # so deep, it is not looked for


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
    facts = {"StatusText": "node camera failed", "InactiveEnterTimestamp": SECOND}
    manager.add(options(), active="failed", NRestarts=2, **facts)
    row = row_of(manager, scope)
    assert (row.status, row.text, row.uptime) == ("Failed", "node camera failed", None)
    assert (row.ended, row.restarts) == (SECOND, 2)
    manager.units["dora-robot.service"]["StatusText"] = "failed: node a: exit code 1"
    assert row_of(manager, scope).text == "node a: exit code 1", "the status says it already"
    manager.units["dora-robot.service"] |= {"ActiveState": "activating", "SubState": "auto-restart"}
    assert row_of(manager, scope).ended == 0


def test_a_killed_runner_has_no_nodes_while_it_awaits_its_restart(scope: Scope) -> None:
    """systemd keeps its STATUS= until then."""
    manager = FakeManager()
    facts = {"SubState": "auto-restart", "StatusText": "2/2 nodes running"}
    manager.add(options(), active="activating", **facts)
    assert (row_of(manager, scope).status, row_of(manager, scope).text) == ("Restarting", "")
    report = why.explain(manager, scope, "robot", NoJournal())  # type: ignore[arg-type]
    assert report.verdict.now == ""
    manager.units["dora-robot.service"]["StatusText"] = "failed: node a: exit code 1"
    assert row_of(manager, scope).text == "node a: exit code 1"


def test_a_row_is_found_by_selector(
    scope: Scope, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = FakeJournal(monkeypatch, tmp_path)
    manager = FakeManager()
    manager.add(
        options(),
        active="failed",
        StatusText="failed: node a: exit code 1",
        InactiveEnterTimestamp=7,
    )
    row = find_row(manager, scope, "robot")
    assert (row.name, row.text, row.ended) == ("robot", "node a: exit code 1", 7)
    (asked,) = journal.asked
    assert "_SYSTEMD_USER_UNIT=dora-robot.service" in asked
    assert read_status(scope, read_cells(manager)[0]) == CellStatus()


def add_ready(manager: FakeManager, scope: Scope, number: int, **table: Any) -> None:
    """A dataflow that is up, and the table of its runner."""
    name = f"robot{number}"
    facts: dict[str, Any] = {"ActiveEnterTimestampMonotonic": now_us() - 9 * SECOND, "NRestarts": 0}
    manager.add(options(name, UUID[:-3] + f"{number:03}"), **facts)
    (manager.group / f"dora-{name}.service").mkdir(parents=True)  # type: ignore[attr-defined]
    samples = (CpuSample(now_us() - 4 * SECOND, {"": 2 * SECOND}),)
    known = {"up_us": now_us() - 9 * SECOND, "is_first": True, "samples": samples, **table}
    write_status(scope, CellStatus(**known), name)


@pytest.fixture
def manager(unit_group: Path) -> FakeManager:
    """A manager without units, whose dora.slice is a directory."""
    manager = FakeManager()
    manager.group = unit_group.parent  # type: ignore[attr-defined]
    return manager


def asked(manager: FakeManager, scope: Scope) -> tuple[int, list[DataflowRow]]:
    """How many questions the table takes, and its rows."""
    manager.questions = 0
    rows = table_of(manager, scope)
    return manager.questions, rows


def test_the_table_of_200_takes_as_many_questions_as_that_of_1(
    manager: FakeManager, scope: Scope
) -> None:
    add_ready(manager, scope, 0)
    questions, (row,) = asked(manager, scope)
    assert questions == 3
    assert row.uptime == pytest.approx(9 * SECOND, rel=0.1)
    assert (row.status, row.restarts, row.uuid) == ("Running", 0, UUID[:-3] + "000")
    for number in range(1, 200):
        add_ready(manager, scope, number)
    assert (asked(manager, scope)[0], len(asked(manager, scope)[1])) == (3, 200)


@pytest.mark.parametrize(
    ("table", "questions"),
    [({"is_first": False}, 1), ({"up_us": 0}, 1), ({"up_us": 2**62}, 1), ({"samples": ()}, 1)],
)
def test_what_a_table_does_not_tell_is_asked_of_its_unit_alone(
    manager: FakeManager, scope: Scope, table: dict[str, Any], questions: int
) -> None:
    """A restarted dataflow, whose count may be reset; the table of an older version; a lie."""
    add_ready(manager, scope, 0)
    add_ready(manager, scope, 1, **table)
    manager.units["dora-robot1.service"]["NRestarts"] = 0 if "is_first" not in table else 3
    found, (_, row) = asked(manager, scope)
    assert found == 3 + questions
    assert row.uptime == pytest.approx(9 * SECOND, rel=0.1)
    assert row.restarts == manager.units["dora-robot1.service"]["NRestarts"]


def test_a_table_of_a_life_that_is_over_tells_nothing(manager: FakeManager, scope: Scope) -> None:
    """RuntimeDirectoryPreserve= keeps it; systemd waits for the next start meanwhile."""
    add_ready(manager, scope, 0)
    waiting = {"ActiveState": "activating", "SubState": "auto-restart", "NRestarts": 1}
    manager.units["dora-robot0.service"] |= waiting
    _, (row,) = asked(manager, scope)
    assert (row.status, row.restarts) == ("Restarting", 1)


def test_a_snapshot_takes_two_questions_of_each(manager: FakeManager, scope: Scope) -> None:
    """Its ExecStart=, and when it was ready; the rest is in the table of its runner."""
    for number in range(3):
        add_ready(manager, scope, number, text="2/2 nodes ready")
    manager.questions = 0
    observed = read_snapshot(manager, scope)
    few = manager.questions
    add_ready(manager, scope, 3, text="2/2 nodes ready")
    manager.questions = 0
    read_snapshot(manager, scope)
    assert manager.questions == few + 2
    assert {one.row.text for one in observed} == {"2/2 nodes ready"}


def test_a_snapshot_says_what_systemd_does(manager: FakeManager, scope: Scope) -> None:
    text = "2/2 nodes ready"
    add_ready(manager, scope, 0, text=text)
    manager.units["dora-robot0.service"] |= {
        "StatusText": text,
        "ActiveEnterTimestamp": SECOND,
        "InactiveExitTimestampMonotonic": 1,
        "ControlGroup": "/dora.slice/dora-robot0.service",
    }
    (observed,), (row,) = read_snapshot(manager, scope), read_rows(manager, scope)
    assert row.ready == SECOND
    alike: dict[str, Any] = {"uptime": 0, "cpu_percent": 0.0}
    assert observed.row._replace(**alike) == row._replace(**alike)


@pytest.mark.usefixtures("unit_group")
def test_a_table_of_another_user_hides_no_failed_node(scope: Scope) -> None:
    """Systemd has the text of the runner for all users."""
    manager = FakeManager()
    text = "1/2 nodes running; failed: plot (exit code 1)"
    unit = manager.add(options(), ControlGroup=GROUP, StatusText=text)
    for row in (row_of(manager, scope), *table_of(manager, scope)):
        assert (row.status, row.text) == ("Degraded", text)
        assert text in format_dataflows([row])
    manager.units[unit]["StatusText"] = "2/2 nodes running"
    assert [row.status for row in table_of(manager, scope)] == ["Running"]
