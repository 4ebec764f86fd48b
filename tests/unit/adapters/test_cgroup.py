"""The cgroup adapter on a directory that looks like a cgroup tree."""

import os
from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.limits import limit_groups
from dora_systemd.decisions.resources.usage import Usage
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY
from tests.unit.fakes.limit_values import limits_from


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    group = tmp_path / "dora-robot.service"
    for name in ("supervisor", "node-camera", "node-a.b"):
        (group / name).mkdir(parents=True)
        (group / name / "cgroup.procs").write_text("")
    (group / "cgroup.procs").write_text("")
    (group / "cpu.stat").write_text("usage_usec 1500\nnr_periods 10\nnr_throttled 3\n")
    return group


def test_node_groups(unit: Path) -> None:
    assert cgroup.node_groups(unit) == {
        "a.b": unit / "node-a.b",
        "camera": unit / "node-camera",
    }
    assert cgroup.node_groups(unit / "gone") == {}


def test_usage_with_a_memory_controller(unit: Path) -> None:
    (unit / "cpu.max").write_text("150000 100000\n")
    for name, text in (("current", "4096\n"), ("peak", "8192\n"), ("max", "max\n")):
        (unit / f"memory.{name}").write_text(text)
    assert cgroup.read_usage(unit) == Usage(1500, 4096, 8192, INFINITY, 1_500_000, (10, 3))
    assert cgroup.read_present(unit) == cgroup.read_usage(unit)._replace(memory_peak=None)


def test_usage_without_a_memory_controller(unit: Path) -> None:
    (unit / "node-camera" / "cgroup.procs").write_text(f"{os.getpid()}\n")
    usage = cgroup.read_usage(unit)
    assert usage.memory is not None
    assert usage.memory > 1024**2
    assert usage.memory_peak is None


def test_limits_of_a_node(unit: Path) -> None:
    group = unit / "node-camera"
    for name in ("memory.max", "cpu.max", "memory.oom.group"):
        (group / name).write_text("")
    cgroup.kill_as_one(group)
    limit_groups([(group, limits_from("camera:memory_limit=1G,cpu_limit=infinity"))])
    assert (group / "memory.oom.group").read_text() == "1"
    assert (group / "memory.max").read_text() == str(1 << 30)
    assert (group / "cpu.max").read_text() == "max 100000"


def test_a_limit_that_nothing_holds_up_is_an_error(unit: Path) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        limit_groups([(unit / "node-camera", limits_from("camera:tasks_limit=5"))])
    assert caught.value.message == "cannot limit the node camera: its group has no pids.max"


@pytest.mark.parametrize("used", ["2-3", "0"])
def test_cpus_of_a_node_are_those_that_the_kernel_uses(unit: Path, used: str) -> None:
    group = unit / "node-camera"
    (group / "cpuset.cpus").write_text("")
    (group / "cpuset.cpus.effective").write_text(f"{used}\n")
    limits = limits_from("camera:cpus=2-3")
    if used == "2-3":
        limit_groups([(group, limits)])
        assert (group / "cpuset.cpus").read_text() == "2-3"
        limit_groups([(group, limits_from("camera:cpus=infinity"))]).close()
        assert (group / "cpuset.cpus").read_text().startswith("2-3")
        return
    with pytest.raises(DoraSystemdError) as caught:
        limit_groups([(group, limits)])
    assert caught.value.message == ("cannot limit the node camera: of the cpus 2-3 it may use 0")


def test_a_node_without_cpus_of_its_own_gets_those_of_the_unit(unit: Path) -> None:
    group = unit / "node-camera"
    (unit / "cpuset.cpus.effective").write_text("0-3\n")
    (group / "cpuset.cpus").write_text("\n")
    (group / "cpuset.cpus.effective").write_text("2")
    limit_groups([(group, limits_from("camera:cpus=2"))]).close()
    assert (group / "cpuset.cpus").read_text() == "0-3"


def test_limits_of_all_nodes_or_of_none(unit: Path) -> None:
    group = unit / "node-camera"
    (group / "memory.max").write_text("max\n")
    limits = limits_from("camera:memory_limit=1G"), limits_from("a.b:memory_limit=1G")
    with pytest.raises(DoraSystemdError, match=r"cannot limit the node a\.b: its group has no"):
        limit_groups(zip((group, unit / "node-a.b"), limits, strict=True))
    assert (group / "memory.max").read_text().startswith("max")


def test_usage_of_a_group_that_has_gone(tmp_path: Path) -> None:
    assert cgroup.read_usage(tmp_path / "gone") == Usage(0, 0)


def test_pids_of_the_whole_tree(unit: Path) -> None:
    (unit / "supervisor" / "cgroup.procs").write_text("1\n2\n")
    (unit / "node-camera" / "cgroup.procs").write_text("3\n")
    assert sorted(cgroup.pids(unit)) == [1, 2, 3]


def test_some_pids_of_a_tree_without_end(unit: Path) -> None:
    """The user of a dataflow can create any number of groups in it."""
    groups = [unit / "node-camera" / f"{number:05}" for number in range(cgroup.MAX_GROUPS + 10)]
    for pid, group in enumerate(groups):
        group.mkdir()
        (group / "cgroup.procs").write_text(f"{pid}\n")
    assert len(cgroup.some_pids(unit / "node-camera")) == cgroup.MAX_GROUPS - 1
    (groups[0] / "cgroup.procs").write_text("5\n" * (cgroup.MAX_PROCESSES + 10))
    assert len(cgroup.some_pids(groups[0])) == cgroup.MAX_PROCESSES


def test_controllers_are_enabled_one_by_one(unit: Path) -> None:
    (unit / "cgroup.controllers").write_text("cpu memory\n")
    (unit / "cgroup.subtree_control").write_text("")
    cgroup.enable_controllers(unit)
    assert (unit / "cgroup.subtree_control").read_text() in ("+memory", "+cpu+memory")


def test_no_controllers_is_no_error(unit: Path) -> None:
    (unit / "cgroup.controllers").write_text("\n")
    (unit / "cgroup.subtree_control").write_text("")
    cgroup.enable_controllers(unit)
    assert not (unit / "cgroup.subtree_control").read_text()


def test_populated(unit: Path) -> None:
    assert not cgroup.is_populated(unit)
    (unit / "cgroup.events").write_text("populated 1\nfrozen 0\n")
    assert cgroup.is_populated(unit)


def test_frozen(unit: Path) -> None:
    assert not cgroup.is_frozen(unit)
    (unit / "cgroup.events").write_text("populated 1\nfrozen 1\n")
    assert cgroup.is_frozen(unit)


def test_processes_are_killed_one_by_one_without_cgroup_kill(unit: Path) -> None:
    child = os.posix_spawn("/bin/sleep", ["sleep", "100"], {})
    (unit / "node-camera" / "cgroup.procs").write_text(f"{child}\n")
    cgroup.kill_group(unit)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == 9


def test_groups_are_made_and_removed(tmp_path: Path) -> None:
    cgroup.make_group(tmp_path / "x")
    cgroup.make_group(tmp_path / "x")
    cgroup.remove_group(tmp_path / "x")
    cgroup.remove_group(tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("place", ["cgroup", "cgroup/unified"])
def test_where_cgroup_v2_is(tmp_path: Path, place: str) -> None:
    places = (tmp_path / "cgroup", tmp_path / "cgroup/unified")
    for one in places:
        one.mkdir()
    with pytest.raises(DoraSystemdError, match=r"^cannot find the cgroup v2 hierarchy") as caught:
        cgroup.mount_point(places)
    assert caught.value.code is ExitCode.NO_SYSTEMD
    assert "systemd.unified_cgroup_hierarchy=1" in caught.value.hint
    (tmp_path / place / "cgroup.procs").touch()
    assert cgroup.mount_point(places) == tmp_path / place


def test_own_group() -> None:
    assert cgroup.group_of().startswith("/")


def test_a_group_whose_name_is_no_text(tmp_path: Path) -> None:
    file = tmp_path / "cgroup"
    file.write_bytes(b"0::/node-\xff\x0bx\n")
    assert cgroup.group_of(f"self/root{file.parent}") == "/node-\udcff\x0bx"


def test_what_the_kernel_refuses_names_the_file(unit: Path) -> None:
    file = unit / "supervisor/cgroup.procs"
    file.unlink()
    file.symlink_to("/dev/full")
    with pytest.raises(OSError, match=f"No space left on device: '{file}'"):
        cgroup.move_process(unit / "supervisor", 0)
