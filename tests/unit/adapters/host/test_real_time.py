"""What this machine offers for real time, read from pretended files."""

import gzip
import os
from pathlib import Path

import pytest

from dora_systemd.adapters.host.real_time import read_real_time
from dora_systemd.decisions.views.findings import RealTime
from tests.unit.fakes.programs import make_program

CPUS = "sys/devices/system/cpu"
CONFIG = "CONFIG_CGROUPS=y\nCONFIG_RT_GROUP_SCHED=y\n# CONFIG_RT_GROUP_SCHED_DEFAULT_DISABLED\n"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The root directory of one that grants root nothing."""
    monkeypatch.setattr("os.geteuid", lambda: 0)
    for name in ("chrt", "prlimit"):
        make_program(tmp_path / "usr/bin" / name, "exit 1")
    for name in ("proc", "boot"):
        (tmp_path / name).mkdir()
    return tmp_path


def test_a_machine_that_says_nothing(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_real_time(machine) == RealTime(None, False, False)
    (machine / "proc/config.gz").write_bytes(b"no gzip")
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert read_real_time(machine) == RealTime()


def test_what_it_grants_root(machine: Path) -> None:
    make_program(machine / "usr/bin/chrt", '[ "$*" = "--fifo 1 /bin/true" ]')
    found = read_real_time(machine)
    assert (found.is_granted, found.can_raise) == (True, False)


@pytest.mark.parametrize("name", ["proc/config.gz", f"boot/config-{os.uname().release}"])
@pytest.mark.parametrize("is_on", [True, False])
def test_its_kernel(machine: Path, name: str, is_on: bool) -> None:
    text = (CONFIG if is_on else CONFIG.replace("=y", "=n")).encode()
    (machine / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    assert read_real_time(machine).has_groups is is_on


@pytest.mark.parametrize(
    ("config", "cmdline", "controllers", "has_groups"),
    [
        ("", "quiet", "cpu memory", True),
        ("", "rt_group_sched=1 rt_group_sched=0", "cpu", False),
        ("CONFIG_RT_GROUP_SCHED_DEFAULT_DISABLED=y\n", "quiet", "cpu", False),
        ("CONFIG_RT_GROUP_SCHED_DEFAULT_DISABLED=y\n", "rt_group_sched=1", "cpu", True),
        ("", "quiet", "memory pids", False),
    ],
)
def test_where_groups_matter(
    machine: Path, config: str, cmdline: str, controllers: str, has_groups: bool
) -> None:
    """Root's own group tells nothing of that of a node."""
    (machine / f"boot/config-{os.uname().release}").write_text(CONFIG + config)
    (machine / "proc/cmdline").write_text(f"{cmdline}\n")
    (machine / "sys/fs/cgroup").mkdir(parents=True)
    (machine / "sys/fs/cgroup/cgroup.controllers").write_text(f"{controllers}\n")
    assert read_real_time(machine).has_groups is has_groups


@pytest.mark.parametrize("uid", [0, 1000])
@pytest.mark.parametrize(("bounding", "can_raise"), [("fcecbfff", False), ("ffffffff", None)])
def test_what_no_service_gets(
    machine: Path, monkeypatch: pytest.MonkeyPatch, uid: int, bounding: str, can_raise: bool | None
) -> None:
    """PID 1 decides for a user and for root; only root can also try."""
    monkeypatch.setattr("os.geteuid", lambda: uid)
    (machine / "proc/1").mkdir()
    (machine / "proc/1/status").write_text(f"Name:\tsystemd\nCapBnd:\t00000000{bounding}\n")
    tried = False if uid == 0 else None
    assert read_real_time(machine).can_raise is (tried if can_raise is None else can_raise)


def test_its_cpus(machine: Path) -> None:
    for number, governor in enumerate(("powersave", "performance", "powersave")):
        place = machine / CPUS / f"cpu{number}/cpufreq"
        place.mkdir(parents=True)
        (place / "scaling_governor").write_text(f"{governor}\n")
    (machine / CPUS / "isolated").write_text("2-3\n")
    found = read_real_time(machine)
    assert (found.isolated, found.governors) == ("2-3", ("performance", "powersave"))
