"""The cgroups of nodes: memory and CPU that run out, and freezing."""

from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup.strain import read_load, read_oom
from dora_systemd.decisions.cell.extra import EXTRA
from dora_systemd.decisions.cell.log_backlog import Marks
from dora_systemd.decisions.life.states import Record
from dora_systemd.decisions.resources.containers import CLIENTS
from dora_systemd.decisions.resources.oom import Owner
from dora_systemd.decisions.resources.pressure import CPU, MEMORY
from dora_systemd.decisions.resources.usage import CpuSample
from dora_systemd.runner.nodes.groups import PROGRAMS, ClientWatch, Hold, Resources

MIB = 1 << 20


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    for name in (".", "supervisor", "node-a", "node-b"):
        group = tmp_path / name
        group.mkdir(exist_ok=True)
        count(group)
        numbers = {"max": 64 * MIB, "peak": 64 * MIB, "current": 10 * MIB, "high": "max"}
        for key, number in numbers.items():
            (group / f"memory.{key}").write_text(f"{number}\n")
    (tmp_path / "node-b/memory.current").write_text(f"{40 * MIB}\n")
    (tmp_path / "memory.max").write_text(f"{99 * MIB}\n")
    return tmp_path


def count(group: Path, kills: int = 0, refusals: int = 0) -> None:
    (group / "memory.events").write_text(f"low 0\noom 9\noom_kill {kills}\n")
    (group / "memory.events.local").write_text(f"oom {refusals}\noom_kill {kills}\n")


def test_nothing_was_killed(unit: Path) -> None:
    assert Resources(unit).explain(unit / "node-a") is None


def test_each_death_is_explained_once(unit: Path) -> None:
    now = [100.0]
    resources, group = Resources(unit, lambda: now[0]), unit / "node-a"
    count(group, kills=2, refusals=1)
    oom = resources.explain(group)
    assert oom is not None
    assert (oom.owner, oom.peak, oom.limit) == (Owner.NODE, 64 * MIB, 64 * MIB)
    assert resources.explain(group) is None
    count(group, kills=3, refusals=1)
    count(unit, kills=3, refusals=1)
    (group / "memory.peak").write_text(f"{30 * MIB}\n")
    whole = resources.explain(group)
    assert whole is not None
    assert (whole.owner, whole.limit) == (Owner.DATAFLOW, 99 * MIB)
    assert (whole.most, whole.most_held) == ("b", 40 * MIB)
    # The kernel had already killed it as well when the counter of the unit was read.
    other = unit / "node-b"
    count(other, kills=1)
    same = resources.explain(other)
    assert same is not None
    assert (same.owner, same.limit) == (Owner.DATAFLOW, 99 * MIB)
    now[0] += 60
    count(group, kills=4, refusals=1)
    last = resources.explain(group)
    assert last is not None
    assert last.owner is Owner.MACHINE


def test_the_most_that_a_group_has_used(unit: Path) -> None:
    resources, stat = Resources(unit), unit / "node-a/memory.stat"
    assert resources.most("a") == {}
    (unit / "node-a/memory.max").write_text("max\n")
    samples: tuple[CpuSample, ...] = ()
    for number, (held, cpu) in enumerate(((20, 0), (50, 4_000_000), (30, 5_000_000))):
        files = f"file {held * MIB // 2}\nfile_mapped {30 * MIB}\n"
        stat.write_text(f"anon {held * MIB}\n{files}shmem {2 * MIB}\n")
        now = CpuSample(number * 5_000_000, {"a": cpu})
        assert [one.node for one in resources.look(samples, now)] == []
        samples = (now,)
    # Of what is mapped, at most what the group has of files counts, without shared memory.
    most = {"held_peak": str(52 * MIB), "mapped_peak": str(75 * MIB), "cpu_peak": "80"}
    assert resources.most("a") == most
    assert resources.most("b") == {}, "no memory.stat, and no CPU time"


@pytest.mark.parametrize("name", EXTRA)
def test_an_added_node_is_none_of_the_dataflow(unit: Path, name: str) -> None:
    resources, group = Resources(unit), (unit / "node-a").rename(unit / f"node-{name}")
    (group / "memory.stat").write_text(f"anon {20 * MIB}\n")
    resources.look((), CpuSample(0, {name: 0}))
    assert resources.most(name) == {}


def test_groups_that_do_nothing_and_have_no_limit(unit: Path) -> None:
    resources = Resources(unit)
    for group in (unit, unit / "node-a", unit / "node-b"):
        (group / "memory.max").write_text("max\n")
    first, second = CpuSample(0, {"": 0}), CpuSample(5_000_000, {"": 40_000})

    def is_quiet(now: CpuSample, *before: CpuSample) -> bool:
        resources.look(before, now)
        return resources.is_quiet

    assert not is_quiet(first), "nothing is known before the first sample"
    assert is_quiet(second, first)
    assert not is_quiet(CpuSample(10_000_000, {"": 100_000}), second)
    (unit / "node-b/memory.high").write_text(f"{MIB}\n")
    assert not is_quiet(second, first)


def test_the_limit_that_throttles(unit: Path) -> None:
    resources = Resources(unit)
    (unit / "node-b/cpu.max").write_text("150000 100000\n")
    found = []
    for number in range(4):
        before = (CpuSample(number * 5_000_000, {}, {"b": (50 * number, 45 * number)}),)
        later = 50 * (number + 1), 45 * (number + 1)
        found += resources.look(before, CpuSample((number + 1) * 5_000_000, {}, {"b": later}))
    assert [one.details["cpu_limit"] for one in found] == ["150"]


def test_limits_that_come_close(unit: Path) -> None:
    resources = Resources(unit)
    (unit / "node-a/memory.stat").write_text(f"anon {50 * MIB}\nfile 7\nshmem {10 * MIB}\n")
    stalled = "some avg10=31.00 avg60=0.00 avg300=0.00 total=1\nfull avg10=0.00\n"
    (unit / "node-b/memory.pressure").write_text(stalled)
    records = []
    for number in range(4):
        before = (CpuSample(number * 5_000_000, {}, {"b": (50 * number, 45 * number)}),)
        later = 50 * (number + 1), 45 * (number + 1)
        records += resources.look(before, CpuSample((number + 1) * 5_000_000, {}, {"b": later}))
    assert [(one.event, one.node) for one in records] == [(MEMORY, "a"), (MEMORY, "b"), (CPU, "b")]


def test_what_is_not_there_is_no_limit(tmp_path: Path) -> None:
    assert read_oom(tmp_path).kills == 0
    assert read_load(tmp_path).limit is None


@pytest.fixture
def group(tmp_path: Path) -> Path:
    (tmp_path / "cgroup.freeze").write_text("0")
    return tmp_path


@pytest.fixture
def hold(group: Path) -> Hold:
    return Hold(group, Marks(hold=10, free=7))


def frozen(group: Path) -> str:
    return (group / "cgroup.freeze").read_text()


def test_held_between_the_marks(hold: Hold, group: Path) -> None:
    hold.look(9)
    assert frozen(group) == "0"
    for backlog in (10, 9, 100, 7):
        hold.look(backlog)
        assert frozen(group) == "1"
    hold.look(6)
    assert frozen(group) == "0"


def test_never_again_after_the_end(hold: Hold, group: Path) -> None:
    hold.look(10)
    hold.end()
    assert frozen(group) == "0"
    hold.look(100)
    assert frozen(group) == "0"


def test_not_while_it_is_exchanged(
    hold: Hold, group: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    hold.look(10)
    with hold.paused():
        now += 1
        hold.look(100)
        assert frozen(group) == "0"
    now += 1
    hold.look(100)
    assert frozen(group) == "1"


def test_an_end_meanwhile_is_an_end(hold: Hold, group: Path) -> None:
    with hold.paused():
        hold.end()
    hold.look(100)
    assert frozen(group) == "0"


def test_a_group_that_cannot_be_frozen(tmp_path: Path) -> None:
    hold = Hold(tmp_path / "gone", Marks(hold=10, free=7))
    hold.look(10)
    assert not hold.is_held
    hold.look(10)
    hold.end()
    assert not (tmp_path / "gone").exists()


def test_a_group_that_has_gone(hold: Hold, group: Path) -> None:
    hold.look(10)
    (group / "cgroup.freeze").unlink()
    hold.look(0)
    assert not hold.is_held
    hold.end()
    assert not (group / "cgroup.freeze").exists()


def process(proc: Path, pid: int, *arguments: str, parent: int = 1) -> None:
    place = proc / str(pid)
    place.mkdir(parents=True)
    name = arguments[0]
    (place / "comm").write_text(f"{name}\n")
    (place / "cmdline").write_text("".join(f"{one}\0" for one in arguments))
    fields = ["S", str(parent), *["0"] * 17, "5000", "0"]
    (place / "stat").write_text(f"{pid} ({name}) {' '.join(fields)}\n")
    (place / "status").write_text(f"Name:\t{name}\nUid:\t1000\t1000\t1000\t1000\n")


def client_group(root: Path, node: str, *pids: int) -> Path:
    place = root / f"node-{node}"
    place.mkdir(exist_ok=True)
    (place / "cgroup.procs").write_text("".join(f"{one}\n" for one in pids))
    return place


def outside(node: str, program: str, container: str = "") -> Record:
    return Record("container-outside", node, {"program": program, "container": container})


def test_the_programs_are_those_that_list_knows() -> None:
    assert {one.encode() for one in CLIENTS} == {*PROGRAMS}


def test_one_event_for_each_client(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 7, "python3", "policy.py")
    process(proc, 8, "docker", "run", "image")
    watch = ClientWatch(proc)
    groups = {"policy": client_group(tmp_path, "policy", 7), "eye": client_group(tmp_path, "eye")}
    assert watch.look(groups) == []
    client_group(tmp_path, "policy", 7, 8)
    assert watch.look(groups) == [outside("policy", "docker")]
    assert watch.look(groups) == [], "it has begun once"
    client_group(tmp_path, "policy", 7)
    assert watch.look(groups) == []
    process(proc, 9, "nerdctl", "run", "--name=b", "image")
    client_group(tmp_path, "policy", 7, 9, 10)
    assert watch.look(groups) == [outside("policy", "nerdctl", "b")], "10 has ended meanwhile"


def test_podman_executes_itself_again(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 8, "podman", "run", "--name", "outer", "image")
    process(proc, 9, "podman", "run", "--name", "outer", "image", parent=8)
    watch = ClientWatch(proc)
    groups = {"policy": client_group(tmp_path, "policy", 8, 9)}
    assert watch.look(groups) == [outside("policy", "podman", "outer")]


def test_what_is_no_container_outside(tmp_path: Path) -> None:
    proc = tmp_path / "proc"
    process(proc, 8, "podman", "run", "--cgroups=split", "image")
    process(proc, 9, "docker", "ps")
    watch = ClientWatch(proc)
    assert watch.look({"policy": client_group(tmp_path, "policy", 8, 9)}) == []
