"""`doractl set`: what systemd is asked, what is remembered, and that bad input changes nothing."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.host.unit_files import (
    SET_FILE,
    changed_files,
    remove_changes,
)
from dora_systemd.decisions.cell.environment import node_environment, with_changes
from dora_systemd.decisions.cell.limits import limits_of
from dora_systemd.decisions.cell.line_rates import parse_rate, rates_of
from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.cell.options import runner_command
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY
from dora_systemd.verbs.facts.cells import Cell, read_cell
from dora_systemd.verbs.reload import switch_hot_reload, switch_record
from dora_systemd.verbs.set import set_limits
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import FakeManager, ScopeIn, options, with_limits, with_texts

NODES = {"camera": NodeStatus("running", 5, kind="python"), "ui": NodeStatus(kind="dynamic")}
FILES = ("memory.max", "cpu.max", "pids.max", "memory.current")


class Place:
    """One dataflow with its cgroup, its unit's files and its node table, all below `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.scope = ScopeIn(is_user=True, uid=1000, root=root / "run")
        self.group = root / "cgroup/unit/node-camera"
        self.group.mkdir(parents=True)
        for name in FILES:
            (self.group / name).write_text("1")
        (root / "cgroup/cgroup.procs").write_text("")
        self.offer(root / "cgroup", "cpu memory pids")
        directory = self.scope.cell_directory("robot")
        directory.mkdir(parents=True)
        (directory / "status.json").write_text(CellStatus(nodes=NODES).to_json())
        self.units = root / "units"
        self.units.mkdir()
        self.manager = FakeManager()
        self.unit = self.manager.add(
            options(),
            ControlGroup="/unit",
            FragmentPath=str(self.units / "dora-robot.service"),
            Environment=["PATH=/bin"],
        )

    def has_file(self) -> None:
        """Let the dataflow be in a file."""
        file = self.root / "robot.yml"
        file.write_text("nodes: [{id: camera, path: camera.py, outputs: [image]}]")
        command = runner_command("/usr/bin/python3", options(dataflow=str(file)))
        self.manager.units[self.unit]["ExecStart"][0][1] = command

    def offer(self, group: Path, controllers: str) -> None:
        (group / "cgroup.controllers").write_text(controllers)

    @property
    def cell(self) -> Cell:
        cell = read_cell(self.manager, self.unit)
        assert cell is not None
        return cell

    @property
    def drop_in(self) -> Path:
        return self.units / "dora-robot.service.d" / SET_FILE

    def set(self, **flags: Any) -> tuple[str, ...]:
        return set_limits(self.manager, self.scope, self.cell, flags)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    fake_cgroups(monkeypatch, tmp_path)
    return Place(tmp_path)


def test_limits_of_the_dataflow(place: Place) -> None:
    assert place.set(memory_limit="6M", cpu_limit="infinity") == ()
    properties = [("CPUQuotaPerSecUSec", "t", INFINITY), ("MemoryMax", "t", 6 << 20)]
    assert place.manager.calls == [("set", place.unit, properties, False)]
    assert not place.drop_in.exists()


def test_limits_of_a_node_hold_now_and_later(place: Place) -> None:
    assert place.set(nodes=("camera:memory_limit=2M,cpu_limit=1.5",)) == ()
    assert place.manager.calls == [("reload",)]
    assert (place.group / "memory.max").read_text() == str(2 << 20)
    assert (place.group / "cpu.max").read_text() == "150000 100000"
    assert place.drop_in.read_text().splitlines()[1:] == [
        "[Service]",
        'Environment="DORA_SYSTEMD_SET=camera:memory_limit=2M camera:cpu_limit=150%%"',
    ]


def test_a_unit_file_keeps_its_changes_until_it_goes(place: Place) -> None:
    place.manager.units[place.unit]["Transient"] = False
    place.set(nodes=("camera:memory_limit=2M",))
    fragment = place.units / "dora-robot.service"
    (drop_in,) = changed_files(fragment)
    assert drop_in == place.root / "units.control/dora-robot.service.d" / SET_FILE
    remove_changes(fragment)
    assert not drop_in.parent.exists()
    remove_changes(fragment)


def test_changes_add_up(place: Place) -> None:
    before = "DORA_SYSTEMD_SET=camera:cpu_limit=150% camera:memory_limit=2M other:tasks_limit=3"
    place.manager.units[place.unit]["Environment"].append(before)
    place.set(nodes=("camera:memory_limit=infinity,tasks_limit=9",), tasks_limit="50")
    assert [call[0] for call in place.manager.calls] == ["set", "reload"]
    assert (
        place.drop_in.read_text()
        .rstrip()
        .endswith(
            "camera:cpu_limit=150%% other:tasks_limit=3 camera:memory_limit=infinity"
            ' camera:tasks_limit=9"'
        )
    )
    assert (place.group / "memory.max").read_text() == "max"


def test_hot_reload_is_remembered_beside_the_limits(place: Place) -> None:
    place.manager.units[place.unit]["Environment"].append("DORA_SYSTEMD_SET=camera:cpu_limit=150%")
    switch_hot_reload(place.manager, place.scope, place.cell, False, lambda *_: {})
    variable = "DORA_SYSTEMD_SET=camera:cpu_limit=150%% hot_reload=no"
    assert f'Environment="{variable}"' in place.drop_in.read_text()


def test_what_a_runner_refuses_is_undone_in_systemd_too(place: Place) -> None:
    """Else `doractl show` would look for the drop-in, which is not there any more."""

    def refuse(*_: object) -> dict[str, Any]:
        raise DoraSystemdError("cannot watch the files")

    with pytest.raises(DoraSystemdError, match="cannot watch"):
        switch_hot_reload(place.manager, place.scope, place.cell, False, refuse)
    assert not place.drop_in.exists()
    assert place.manager.calls == [("reload",), ("reload",)]


def test_a_runner_that_is_gone_is_asked_nothing(place: Place) -> None:
    place.manager.units[place.unit]["SubState"] = "auto-restart"
    with pytest.raises(DoraSystemdError, match="robot: it waits for its restart") as caught:
        switch_hot_reload(place.manager, place.scope, place.cell, False)
    assert caught.value.code is ExitCode.NOT_RUNNING
    assert caught.value.hint == "doractl restart robot starts it now"


def test_a_release_has_no_hot_reload(place: Place) -> None:
    file = "/var/lib/dora-systemd/releases/robot/20261129T005719/tree/dataflow.yml"
    place.manager.add(options()._replace(dataflow=file))
    with pytest.raises(DoraSystemdError, match="cannot set the hot reload of robot: the files of"):
        switch_hot_reload(place.manager, place.scope, place.cell, True)


@pytest.mark.parametrize(("text", "warns"), [("off", False), ("memory=4M", True)])
def test_a_recorder_that_was_not_started_needs_a_restart(
    place: Place, text: str, warns: bool
) -> None:
    place.has_file()
    found = switch_record(place.manager, place.scope, place.cell, text, lambda *_: {})
    what = "was started without record, and records from its restart on"
    expected = (f"{place.cell.name} {what}: doractl restart {place.cell.name}",)
    assert found == (expected if warns else ())
    assert "record=" in place.drop_in.read_text()


@pytest.mark.parametrize(
    ("text", "problem"),
    [("outputs=camera/sound", "'camera/sound': no such output"), ("memory=9999T", "9999T")],
)
def test_a_recorder_that_could_not_start_is_refused_now(
    place: Place, text: str, problem: str
) -> None:
    """Else the next restart would fail, and end the dataflow."""
    place.has_file()
    with pytest.raises(DoraSystemdError, match=problem):
        switch_record(place.manager, place.scope, place.cell, text, lambda *_: {})
    assert not place.drop_in.exists()


def test_what_is_too_small_or_too_large_is_said(place: Place) -> None:
    (place.group / "memory.current").write_text(str(5 << 20))
    with pytest.raises(DoraSystemdError) as caught:
        place.set(nodes=("camera:memory_limit=2M",))
    told = "cannot limit the memory of the node camera to 2M: it uses 5M now"
    assert (caught.value.message, "--force" in caught.value.hint) == (told, True)
    assert (place.manager.calls, place.drop_in.exists()) == ([], False)
    flags = {"nodes": ("camera:memory_limit=2M",), "cpu_limit": "99999"}
    (warning,) = set_limits(place.manager, place.scope, place.cell, flags, is_forced=True)
    assert "than this machine has" in warning
    assert "camera:memory_limit=2M" in place.drop_in.read_text()


def test_a_limit_below_what_the_dataflow_uses(place: Place) -> None:
    (place.root / "cgroup/unit/memory.current").write_text(str(300 << 20))
    with pytest.raises(DoraSystemdError) as caught:
        place.set(memory_limit="5M")
    told = "cannot limit the memory of the dataflow to 5M: it uses 300M now"
    assert (caught.value.message, place.manager.calls) == (told, [])


def test_no_process_can_start_below_the_present_tasks(place: Place) -> None:
    """The next restart of a node would fail, and that of the dataflow, without a reason."""
    whole = place.group.parent
    (whole / "pids.current").write_text("73")
    (place.group / "pids.current").write_text("19")
    for flags, what in (
        ({"tasks_limit": "72"}, "the dataflow to 72: it has 73 now"),
        ({"nodes": ("camera:tasks_limit=18",)}, "the node camera to 18: it has 19 now"),
    ):
        with pytest.raises(DoraSystemdError) as caught:
            place.set(**flags)
        assert caught.value.message == f"cannot limit the tasks of {what}"
        assert caught.value.hint == "--force does it; no process and no thread can start then"
        set_limits(place.manager, place.scope, place.cell, flags, is_forced=True)
    place.set(nodes=("camera:tasks_limit=19",), tasks_limit="73")


def test_no_force_for_a_limit_that_systemd_would_hang_in(place: Place) -> None:
    (place.root / "cgroup/unit/memory.stat").write_text(f"anon {40 << 20}\nshmem {8 << 20}\n")
    flags = {"memory_limit": "19M"}
    with pytest.raises(DoraSystemdError) as caught:
        set_limits(place.manager, place.scope, place.cell, flags, is_forced=True)
    assert "to 19M: 8M are files in memory, which stay when" in caught.value.message
    assert caught.value.hint.startswith("20M or more")
    assert place.manager.calls == []
    set_limits(place.manager, place.scope, place.cell, {"memory_limit": "20M"}, is_forced=True)
    assert place.manager.calls


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        ({}, ExitCode.USAGE, "none is given"),
        ({"memory_limit": "0"}, ExitCode.USAGE, "'0'"),
        ({"memory_limit": "6M", "cpu_limit": "-1"}, ExitCode.USAGE, "'-1'"),
        ({"memory_limit": "6M", "nodes": ("camera:cpu_limit=x",)}, ExitCode.USAGE, "'x'"),
        ({"memory_limit": "6M", "nodes": ("nobody:cpu_limit=1",)}, ExitCode.BAD_INPUT, "'nobody'"),
        ({"nodes": ("camera:cpu_limit=1", "ui:cpu_limit=1")}, ExitCode.BAD_INPUT, "dynamic"),
        ({"memory_limit": "6M", "io_weight": "5"}, ExitCode.NO_SYSTEMD, "'io' cgroup controller"),
    ],
)
def test_nothing_changes_if_anything_is_wrong(
    place: Place, flags: dict[str, Any], code: ExitCode, words: str
) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        place.set(**flags)
    assert (caught.value.code, words in caught.value.message) == (code, True)
    assert place.manager.calls == []
    assert not place.drop_in.exists()
    assert (place.group / "cpu.max").read_text() == "1"


@pytest.mark.parametrize("refuser", ["kernel", "systemd", "disk"])
def test_nothing_changes_if_somebody_refuses(
    place: Place, refuser: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = {"nodes": ("camera:memory_limit=2M,tasks_limit=9",), "memory_limit": "6M"}
    (place.group / "memory.max").write_text(str(1 << 20))
    if refuser == "kernel":
        (place.group / "pids.max").unlink()
        (place.group / "pids.max").mkdir()
    elif refuser == "systemd":

        def refuse(*_: object) -> None:
            raise DoraSystemdError("cannot change it: systemd says no")

        monkeypatch.setattr(place.manager, "set_properties", refuse)
    else:
        (place.units / "dora-robot.service.d").write_text("in its way")
    with pytest.raises(DoraSystemdError):
        place.set(**flags)
    assert place.manager.calls == []
    assert not place.drop_in.is_file()
    assert (place.group / "memory.max").read_text() == str(1 << 20)


def test_what_was_changed_before_stays_when_systemd_refuses(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    place.set(nodes=("camera:memory_limit=2M",))
    before = place.drop_in.read_text()

    def refuse(*_: object) -> None:
        raise DoraSystemdError("cannot change it: systemd says no")

    monkeypatch.setattr(place.manager, "set_properties", refuse)
    with pytest.raises(DoraSystemdError):
        place.set(nodes=("camera:memory_limit=3M",), memory_limit="6M")
    assert place.drop_in.read_text() == before
    assert (place.group / "memory.max").read_text() == str(2 << 20)


def test_a_node_without_a_group_is_limited_at_its_next_start(place: Place) -> None:
    for name in FILES:
        (place.group / name).unlink()
    place.group.rmdir()
    place.set(nodes=("camera:memory_limit=2M",))
    assert "camera:memory_limit=2M" in place.drop_in.read_text()


def test_root_is_needed_for_others(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    place.scope = ScopeIn(is_user=False, uid=1000, root=place.scope.root)
    with pytest.raises(DoraSystemdError) as caught:
        place.set(memory_limit="6M")
    assert caught.value.code is ExitCode.NO_PERMISSION


class Runner:
    """Keeps what it is asked for; refuses if there is a problem."""

    def __init__(self, problem: str = "", code: ExitCode = ExitCode.FAILURE) -> None:
        self.asked: list[Any] = []
        self.problem, self.code = problem, code

    def __call__(self, path: Path, request: Mapping[str, Any]) -> dict[str, Any]:
        assert path.name == "runner.sock"
        self.asked.append(request["limits"])
        if self.problem:
            raise DoraSystemdError(self.problem, code=self.code)
        return {"done": []}


def rates(place: Place, *texts: str, runner: Runner, **flags: Any) -> tuple[str, ...]:
    for text in texts:
        node, _, rate = text.rpartition("=")
        given = (f"{node}:log_rate_limit={rate}",)
        flags |= {"nodes": given} if node else {"log_rate_limit": rate}
    return set_limits(place.manager, place.scope, place.cell, flags, ask=runner)


def test_lines_of_a_running_dataflow(place: Place) -> None:
    runner = Runner()
    place.manager.units[place.unit]["Environment"] = [
        "DORA_SYSTEMD_SET=ui:log_rate_limit=9/1s 'log_rate_limit=50/1min 30s'"
    ]
    rates(place, "camera=10/1s", "100/1s", runner=runner)
    expected = [("", "100/1s"), ("ui:", "9/1s"), ("camera:", "10/1s")]
    assert runner.asked == [[f"{one[0]}log_rate_limit={one[1]}" for one in expected]]
    text = place.drop_in.with_name(SET_FILE).read_text()
    assert "ui:log_rate_limit=9/1s log_rate_limit=100/1s camera:log_rate_limit=10/1s" in text
    assert place.manager.calls == [("reload",)]


def test_lines_of_nodes_on_other_machines(place: Place) -> None:
    command = runner_command("/usr/bin/python3", options(placed=(Placed("yolo", "gpu"),)))
    place.manager.units[place.unit]["ExecStart"][0][1] = command
    assert "the nodes on gpu keep their limits" in rates(place, "9/1s", runner=Runner())[0]
    assert rates(place, "camera=9/1s", runner=Runner()) == ()


@pytest.mark.parametrize("facts", [{"ControlGroup": ""}, {"ActiveState": "inactive"}])
def test_lines_of_one_that_does_not_run(place: Place, facts: dict[str, str]) -> None:
    """One that is down has a group as soon as systemd has set a limit of it."""
    runner = Runner()
    place.manager.units[place.unit] |= facts
    rates(place, "camera=infinity", runner=runner)
    assert runner.asked == []
    assert "camera:log_rate_limit=infinity" in place.drop_in.with_name(SET_FILE).read_text()


def test_a_rate_that_nobody_takes_changes_nothing(place: Place) -> None:
    for texts in (["nobody=1/1s"], ["camera=1/1h", "1"]):
        with pytest.raises(DoraSystemdError):
            rates(place, *texts, runner=(runner := Runner()))
        assert runner.asked == []
    with pytest.raises(DoraSystemdError, match="it hangs"):
        rates(place, "1/1s", runner=Runner("it hangs"))
    assert not place.drop_in.parent.exists()
    assert place.manager.calls == []


def test_lines_that_systemd_refuses(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise DoraSystemdError("cannot change it: systemd says no")

    monkeypatch.setattr(place.manager, "set_properties", refuse)
    runner = Runner()
    with pytest.raises(DoraSystemdError):
        rates(place, "ui=1/1s", runner=runner, memory_limit="6M")
    assert runner.asked == [["ui:log_rate_limit=1/1s"], []]
    assert not place.drop_in.parent.exists()


def test_lines_of_the_next_runner() -> None:
    before = with_texts(options(), "log_rate_limit=9/1s", "camera:log_rate_limit=8/1s")
    texts = "camera:log_rate_limit=infinity 'ui:log_rate_limit=50/1min 30s'"
    variables = {"DORA_SYSTEMD_SET": texts}
    expected = {"": parse_rate("9/1s"), "camera": None, "ui": parse_rate("50/90s")}
    assert rates_of(with_changes(before, variables)) == expected
    assert node_environment(variables) == {}


def test_the_runner_is_told() -> None:
    before = with_limits(options(), limits_from("camera:cpu_limit=1,memory_limit=1G"))
    variables = {"DORA_SYSTEMD_SET": "camera:memory_limit=2G ui:tasks_limit=9"}
    assert with_changes(before, {}) == before
    assert limits_of(with_changes(before, variables)) == (
        limits_from("camera:cpu_limit=1,memory_limit=2G"),
        limits_from("ui:tasks_limit=9"),
    )
    assert node_environment(variables) == {}


def test_a_reload_that_systemd_refuses_leaves_nothing(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with /run nearly full. The drop-in would stay, and hold for the next of this name."""

    def refuse() -> None:
        raise DoraSystemdError("cannot reload systemd: not enough space available")

    monkeypatch.setattr(place.manager, "reload", refuse)
    with pytest.raises(DoraSystemdError, match="not enough space"):
        place.set(nodes=("camera:memory_limit=2M",))
    with pytest.raises(DoraSystemdError, match="not enough space"):
        switch_hot_reload(place.manager, place.scope, place.cell, True, lambda *_: {})
    assert not place.drop_in.parent.exists()
    # Unlike one of the kernel's files, this one keeps the digits that are not written over.
    assert (place.group / "memory.max").read_text() == "1" + str(2 << 20)[1:]
