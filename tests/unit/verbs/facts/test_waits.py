"""Who had the CPUs of a node: a fake cgroup tree, and a fake /proc."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.adapters.cgroup.groups import MAX_GROUPS
from dora_systemd.adapters.host.rivals import Interrupts
from dora_systemd.decisions.resources.rivals import Rival
from dora_systemd.decisions.why.waits import MINUTE, CpuWait
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.reading import read_dataflow
from dora_systemd.verbs.facts.waits import read_cpu_waits, shared_interrupts
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.limit_values import limits_from
from tests.unit.fakes.manager import FakeManager, ScopeIn, options, with_limits, with_texts

GROUP = "/dora.slice/dora-robot.service"
PSI = "some avg10=0.00 avg60={} avg300=0.00 total=1500\n"
Write = Callable[[str, str], None]


@pytest.fixture
def scope(tmp_path: Path) -> Scope:
    return ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Writes a control file of the only node."""
    node = fake_cgroups(monkeypatch, tmp_path) / GROUP[1:] / "node-camera"
    node.mkdir(parents=True)

    def write(name: str, text: str) -> None:
        (node / name).write_text(text)

    return write


@pytest.fixture
def proc(tmp_path: Path) -> Path:
    """The files of two processes, which use_cpu() changes: one of the node, and another one."""
    place = tmp_path / "proc"
    for pid, group in ((11, f"{GROUP}/node-camera"), (12, "/dora.slice/dora-b.service/node-n/x")):
        (place / f"{pid}/task/{pid}").mkdir(parents=True)
        (place / f"{pid}/cgroup").write_text(f"0::{group}\n")
    use_cpu(place, 0)
    return place


def use_cpu(proc: Path, seconds: float) -> None:
    """Both processes have used a CPU for so long, and waited as long."""
    for pid, cpu in ((11, 0), (12, 1)):
        numbers = f"R 1 1 1 0 -1 0 0 0 0 0 {int(seconds * 100)} 0{' 0' * 23} {cpu} 0 0"
        for path in (proc / f"{pid}", proc / f"{pid}/task/{pid}"):
            (path / "stat").write_text(f"{pid} (burn) {numbers}\n")
            (path / "schedstat").write_text(f"0 {int(seconds * 1e9)} 0\n")


def waits(scope: Scope, proc: Path, cpus: str = "") -> tuple[CpuWait, ...]:
    runner = with_texts(options(), "camera:needs=/dev/null", "camera:needs=/etc/passwd")
    if cpus:
        runner = with_limits(runner, limits_from(f"camera:cpus={cpus}"))
    manager = FakeManager()
    manager.add(runner, ControlGroup=GROUP)
    (cell,) = read_cells(manager)

    def sleep(seconds: float) -> None:
        time.sleep(seconds)
        use_cpu(proc, seconds)

    return read_cpu_waits(read_dataflow(manager, scope, cell), proc, sleep)


def test_nobody_waits(scope: Scope, write: Write, proc: Path) -> None:
    write("cpu.pressure", PSI.format("3.00"))
    assert waits(scope, proc) == ()


def test_a_busy_process_is_named(scope: Scope, write: Write, proc: Path) -> None:
    write("cpu.pressure", PSI.format("31.25"))
    write("cgroup.procs", "11\n")
    (one,) = waits(scope, proc)
    assert (one.node, one.waited, one.span, one.shared) == ("camera", 31.25, MINUTE, ())
    (rival,) = one.rivals
    assert rival._replace(cpu_percent=0) == Rival(12, "burn", 0, "n of b"), "not its own process"
    assert 20 < rival.cpu_percent <= 110


def test_not_all_groups_that_a_node_makes_are_read(
    scope: Scope, write: Write, proc: Path, tmp_path: Path
) -> None:
    """A hundred thousand take `why` and the status page seconds."""
    write("cpu.pressure", PSI.format("31.25"))
    write("cgroup.procs", "11\n")
    (node,) = tmp_path.rglob("node-camera")
    for number in range(MAX_GROUPS):
        deep = node / f"{number}/deep"
        deep.mkdir(parents=True)
        (deep / "cgroup.procs").write_text("12\n")
    (one,) = waits(scope, proc)
    assert [rival.pid for rival in one.rivals] == [12]


@pytest.mark.parametrize(
    "group",
    [
        "/dora.slice/dora-a.service/dora-b.service/node-n",
        "/user.slice/user-1000.slice/session-1.scope/dora-b.service/node-n",
        "/user.slice/user-1000.slice/user@1000.service/app.slice/dora-b.service/node-n",
    ],
)
def test_a_group_that_only_has_the_name_of_a_node(
    scope: Scope, write: Write, proc: Path, group: str
) -> None:
    """The user of a dataflow chooses names in it, and can have one of that name."""
    write("cpu.pressure", PSI.format("31.25"))
    write("cgroup.procs", "11\n")
    (proc / "12/cgroup").write_text(f"0::{group}\n")
    (one,) = waits(scope, proc)
    assert [(rival.pid, rival.node) for rival in one.rivals] == [(12, "")]


def test_a_process_on_another_cpu_is_no_rival(scope: Scope, write: Write, proc: Path) -> None:
    write("cpu.pressure", PSI.format("31.25"))
    (there,), (elsewhere,) = waits(scope, proc, "1"), waits(scope, proc, "8000")
    assert [rival.pid for rival in there.rivals] == [12]
    assert (elsewhere.cpus, elsewhere.rivals) == ("8000", ())


def test_a_limit_that_throttles(scope: Scope, write: Write, proc: Path) -> None:
    write("cpu.pressure", PSI.format("0.00"))
    write("cpu.max", "50000 100000\n")
    write("cpu.stat", "usage_usec 9\nnr_periods 10\nnr_throttled 6\n")
    assert waits(scope, proc) == (CpuWait("camera", throttled=60.0),)


def test_without_pressure_the_delay_is_measured(scope: Scope, write: Write, proc: Path) -> None:
    write("cgroup.procs", "11\n")
    (one,) = waits(scope, proc)
    assert one.waited is not None
    assert 20 < one.waited <= 100
    assert one.span < MINUTE
    assert [rival.pid for rival in one.rivals] == [12]


def test_interrupts_of_settings(tmp_path: Path) -> None:
    """Those of an interface, on the CPUs of the node that needs it."""
    device = tmp_path / "sys/devices/pci0/net/can0"
    for path, text in {
        tmp_path / "proc/interrupts": "  CPU0 CPU1\n 7: 5 0  PCI  0-edge  can0\n",
        tmp_path / "proc/irq/7/smp_affinity_list": "0",
        tmp_path / "sys/devices/system/cpu/online": "0-1",
        device / "uevent": "",
        tmp_path / "sys/class/net/x": "",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "sys/class/net/can0").symlink_to(device)
    needing = with_texts(options(), "arm:needs=net:can0", "camera:needs=net:can0")
    bound = with_limits(needing, *map(limits_from, ("arm:cpus=0", "camera:cpus=1")))
    (one,) = shared_interrupts(Interrupts(tmp_path), bound)
    assert (one.node, one.needs, one.numbers, one.elsewhere) == ("arm", "net:can0", (7,), "1")
    assert list(shared_interrupts(Interrupts(tmp_path), needing)) == []
