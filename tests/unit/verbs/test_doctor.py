"""doctor against a fake systemd, and without any."""

import errno
import os
import pwd
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dora_systemd import __version__
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.gateway.place import SOCKET_UNIT
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.doctor import JOURNALD, examine, guarded, judge_no_user
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.start.programs import version_warnings
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options, with_texts
from tests.unit.fakes.programs import make_dora, make_program
from tests.unit.verbs.start.test_programs import install
from tests.unit.verbs.start.test_start import make_plan, place

GONE = 3_999_999_999
"""A uid that nobody has."""


@pytest.fixture
def manager(manager: FakeManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeManager:
    """A machine where all is well. Its files are below tmp_path."""
    manager.units[JOURNALD] = {"ActiveState": "active", "ExecMainStartTimestamp": 1}
    manager.units["dora.target"] = {"LoadState": "loaded", "WantedBy": ["multi-user.target"]}
    mount = fake_cgroups(monkeypatch, tmp_path)
    (mount / "cgroup.controllers").write_text("cpu cpuset io memory pids\n")
    FakeJournal(monkeypatch, tmp_path)
    make_dora(tmp_path / "bin/dora", "1.1.0")
    make_program(tmp_path / "bin/systemd-analyze")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CONFIG_HOME", "/config")
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    monkeypatch.setattr(pwd, "getpwnam", lambda name: pwd.getpwuid(GONE if name == "gone" else 0))
    return manager


def look(manager: FakeManager, scope: Scope) -> list[Finding]:
    """The findings; the directory of the runtime directories has all files of the machine."""
    assert isinstance(scope, ScopeIn)
    return examine(lambda _scope: manager, scope, scope.root.parent)


def found(manager: FakeManager, scope: Scope) -> dict[str, Finding]:
    """The last finding of each topic that is not as it should be."""
    findings = look(manager, scope)
    return {one.topic: one for one in findings if one.state is not State.OK}


def test_all_is_well(manager: FakeManager, scope: Scope) -> None:
    findings = look(manager, scope)
    assert {one.state for one in findings} == {State.OK}
    assert {one.topic for one in findings} == {
        *("systemd", "cgroup", "boot", "left over", "journal", "log rate", "dora", "user"),
        *("port 6013", "port 53290", "bare dora", "real time", "cpuset"),
    }
    assert not any(one.remedy for one in findings)


def test_its_own_gateway_is_no_stranger(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    line = "0: 0100007F:{:04X} 00000000:0000 0A 00000000:00000000 00:00000000 00000000 0 0 7 1 0\n"
    (tmp_path / "proc/net").mkdir(parents=True)
    (tmp_path / "proc/net/tcp").write_text("".join(line.format(port) for port in (6013, 53290)))
    assert {"port 6013", "port 53290"} <= found(manager, scope).keys()
    facts = {"LoadState": "loaded", "ActiveState": "active"}
    manager.units[SOCKET_UNIT] = {**facts, "Listen": [["Stream", "127.0.0.1:53290"]]}
    assert "port 53290" not in found(manager, scope)
    assert "port 6013" in found(manager, scope)


def test_a_stop_that_is_longer_than_that_of_its_user(manager: FakeManager, tmp_path: Path) -> None:
    user = ScopeIn(is_user=True, uid=1000, root=tmp_path / "run")
    manager.add(options(), TimeoutStopUSec=300_000_000)
    manager.units["user@1000.service"] = {"TimeoutStopUSec": 120_000_000}
    assert "the stop of robot may take 5min" in found(manager, user)["stop"].text
    manager.units["user@1000.service"] = {"TimeoutStopUSec": 300_000_000}
    assert "stop" not in found(manager, user)


def test_without_systemd(manager: FakeManager, scope: Scope) -> None:
    def reach(_scope: Scope) -> FakeManager:
        raise DoraSystemdError("cannot reach systemd", "boot with it", ExitCode.NO_SYSTEMD)

    del manager
    first, *rest = examine(reach, scope)
    assert first == Finding("systemd", State.PROBLEM, "cannot reach systemd", "boot with it")
    assert {one.topic for one in rest} >= {"journal", "dora", "bare dora"}


def test_what_an_old_systemd_lacks_comes_last(manager: FakeManager, scope: Scope) -> None:
    manager.systemd = "252.39-1~deb12u1"
    first, *_, last = look(manager, scope)
    assert (first.topic, last.topic) == ("systemd", "properties")
    assert "DelegateSubgroup" in last.text
    assert "DelegateSubgroup" not in first.text


def journal_lines(manager: FakeManager, scope: Scope) -> list[str]:
    return [f"{one.state}: {one.text}" for one in look(manager, scope) if one.topic == "journal"]


def test_files_of_an_earlier_journal_prove_nothing(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    """journald was restarted with another Storage=; the user's scope asks the system's journald."""
    config = tmp_path / "bin/systemd-analyze"
    old = tmp_path / "var/log/journal/machine/system.journal"
    manager.units[JOURNALD]["ExecMainStartTimestamp"] = old.stat().st_mtime_ns // 1000 + 1
    make_program(config, "printf '[Journal]\\nStorage=auto\\n[Journal]\\n Storage = none\\n'")
    user = ScopeIn(is_user=True, uid=0, root=tmp_path / "run")
    for asked in (scope, user):
        (line,) = journal_lines(manager, asked)
        assert line == "warning: no line is kept: journald has Storage=none"
    make_program(config, "printf '[Journal]\\nStorage=volatile\\n'")
    new = tmp_path / "run/log/journal/machine/system.journal"
    new.parent.mkdir(parents=True)
    new.touch()
    os.utime(new, ns=(0, old.stat().st_mtime_ns + 2000))
    (line,) = journal_lines(manager, scope)
    assert line == "warning: it is kept in memory and lost at a reboot"


def test_without_journald_one_line_says_so(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    manager.units[JOURNALD]["ActiveState"] = "inactive"
    for _ in range(2):  # with old files, and without any
        (line,) = journal_lines(manager, scope)
        assert line == "warning: systemd-journald does not run: no line is kept"
        (tmp_path / "var/log/journal/machine/system.journal").unlink(missing_ok=True)


def test_what_others_have_set_up(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    for name, text in {
        "proc/sys/kernel/core_pattern": "|/usr/share/apport/apport -p%p\n",
        "etc/apt/apt.conf.d/20auto-upgrades": 'APT::Periodic::Unattended-Upgrade "1";\n',
        "etc/apt/apt.conf.d/50unattended": 'Unattended-Upgrade::Automatic-Reboot "true";\n',
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    findings = found(manager, scope)
    assert findings["core dumps"].state is State.NOTE
    assert findings["upgrades"].state is State.WARNING


@pytest.mark.parametrize(
    ("option", "reserved", "is_noted"),
    [("memory_hugetlb_accounting", "8", True), ("memory_hugetlb_accounting", "0", False),
     ("memory_recursiveprot", "8", False)],
)  # fmt: skip
def test_huge_pages(
    manager: FakeManager, scope: Scope, tmp_path: Path, option: str, reserved: str, is_noted: bool
) -> None:
    """systemd 259 and newer mount the hierarchy so that they count against MemoryMax=."""
    for name, text in {
        "proc/self/mounts": f"cgroup2 /sys/fs/cgroup cgroup2 rw,nsdelegate,{option} 0 0\n\n",
        "proc/sys/vm/nr_hugepages": f"{reserved}\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    findings = found(manager, scope)
    assert ("huge pages" in findings) is is_noted
    if is_noted:
        assert "memory limits" in findings["huge pages"].remedy


def test_core_dumps_of_a_machine(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    config = tmp_path / "bin/systemd-analyze"
    make_program(config, "echo ProcessSizeMax=0")
    program = tmp_path / "usr/lib/systemd/systemd-coredump"
    for path, text in {
        tmp_path / "proc/sys/kernel/core_pattern": "|/usr/lib/systemd/systemd-coredump %P\n",
        program: "",
        tmp_path / "run/systemd/container": "systemd-nspawn\n",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert "to its host" in found(manager, scope)["core dumps"].text
    (tmp_path / "run/systemd/container").unlink()
    assert "ProcessSizeMax=" in found(manager, scope)["core dumps"].text
    make_program(config, "echo")
    assert "core dumps" not in found(manager, scope)
    program.unlink()
    assert "not installed" in found(manager, scope)["core dumps"].text


def test_interrupts_on_the_cpus_of_a_node(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    device = tmp_path / "sys/devices/pci0/net/can0"
    for path, text in {
        tmp_path / "proc/interrupts": "  CPU0 CPU1\n 7: 5 0  PCI  0-edge  mcp251x\n",
        tmp_path / "proc/irq/7/smp_affinity_list": "0-1",
        tmp_path / "sys/devices/system/cpu/online": "0-1",
        device / "irq": "7\n",
        tmp_path / "sys/class/net/eth0": "",
    }.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "sys/class/net/can0").symlink_to(device)
    manager.add(with_texts(options(), "arm:needs=net:can0", "arm:cpus=1"))
    finding = found(manager, scope)["interrupts"]
    words = "robot/arm: cpus 1 also have the interrupts of mcp251x (net:can0)"
    assert (finding.state, finding.text) == (State.NOTE, words)
    assert finding.remedy == "as root: echo 0 > /proc/irq/7/smp_affinity_list"


def test_a_kernel_that_does_not_measure(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    (tmp_path / "proc/sys/kernel").mkdir(parents=True)
    (tmp_path / "proc/sys/kernel/core_pattern").write_text("core\n")
    assert found(manager, scope)["pressure"].remedy == "boot with psi=1"
    (tmp_path / "proc/pressure").mkdir()
    assert "pressure" not in found(manager, scope)


def test_nodes_with_another_dora(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    venv = install(tmp_path / "venv", "dora_rs", "1.0.1")
    prefix = install(tmp_path / "tool", "dora_rs_cli", "1.1.0")
    manager.add(options(venv=venv, dora=f"{prefix}/bin/dora"))
    finding = found(manager, scope)["versions"]
    assert finding.text == "robot: the nodes' dora is 1.0.1, the daemon is 1.1.0"
    assert finding.remedy.endswith("dora-rs==1.1.0")
    (cell,) = read_cells(manager)
    assert [*version_warnings(manager, [cell])] == [f"{finding.text}: {finding.remedy}"]


@pytest.mark.parametrize("user", ["", "gone"])
def test_a_venv_that_hides_no_other(manager: FakeManager, scope: Scope, user: str) -> None:
    """What its owner has there, or that this user is gone, concerns one dataflow alone."""
    place = scope.runtime_root / "programs"
    prefix = install(place / "tool", "dora_rs_cli", "1.1.0")
    for name, version in (("arm", "0.3.0"), ("robot", "1.0.1")):
        venv = install(place / name, "dora_rs", version)
        unit = manager.add(options(name, venv=venv, dora=f"{prefix}/bin/dora"))
        manager.units[unit]["User"] = user if name == "arm" else ""
    first, second = (one.text for one in look(manager, scope) if one.topic == "versions")
    assert ("user gone: there is none" if user else "0.3.0, 1.0 or newer is needed") in first
    assert second == "robot: the nodes' dora is 1.0.1, the daemon is 1.1.0"


def test_dataflows_of_another_version(manager: FakeManager, scope: Scope) -> None:
    manager.add(options())
    directory = scope.cell_directory("robot")
    directory.mkdir(parents=True)
    (directory / "status.json").write_text(CellStatus(UUID, version="0.0.9").to_json())
    finding = found(manager, scope)["versions"]
    assert finding.text == f"robot: runs 0.0.9, {__version__} is installed"
    assert (finding.state, finding.remedy) == (State.NOTE, "doractl restart robot")


def test_the_remedy_for_a_missing_user_makes_it(tmp_path: Path) -> None:
    """setup does nothing where the package is installed."""
    assert judge_no_user(tmp_path).remedy.startswith("as root: doractl setup;")
    unit = tmp_path / "usr/lib/systemd/system/dora.slice"
    unit.parent.mkdir(parents=True)
    unit.touch()
    assert judge_no_user(tmp_path).remedy.startswith("as root: systemd-sysusers;")


def test_what_ended_dataflows_have_left(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    manager.add(options())
    for name in ("robot", "ghost"):
        scope.cell_directory(name).mkdir(parents=True)
        group = tmp_path / f"cgroup/dora.slice/dora-{name}.service"
        group.mkdir(parents=True)
        (group / "cgroup.events").write_text("populated 1\n")
    findings = look(manager, scope)
    left = [one for one in findings if one.topic == "left over"]
    assert [one.state for one in left] == [State.WARNING] * 2
    assert left[0].remedy == f"rm -r {scope.cell_directory('ghost')}"
    assert left[1].remedy.endswith("dora-ghost.service/cgroup.kill")


def place_with_file(manager: FakeManager, scope: Scope, flow: Path) -> None:
    """Enable a dataflow whose file exists."""
    flow.touch()
    plan = make_plan(scope)
    options = plan.options._replace(dataflow=str(flow))
    place(manager, plan._replace(options=options), want_boot=True)


def test_an_enabled_dataflow_that_systemd_has_lost(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    flow = tmp_path / "robot.yml"
    place_with_file(manager, scope, flow)
    (finding,) = found(manager, scope).values()
    assert finding.text == "dora-robot.service is enabled and systemd does not know it"
    assert finding.remedy == "systemctl --system daemon-reload"


def test_an_enabled_dataflow_whose_file_is_gone(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    (finding,) = found(manager, scope).values()
    assert finding.text == "robot is enabled, but /srv/robot.yml does not exist"
    assert finding.remedy == "doractl disable robot"


def test_an_enabled_dataflow_whose_python_is_gone(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    """As after uv tool uninstall and an installation by pipx."""
    flow = tmp_path / "my robot.yml"
    place_with_file(manager, scope, flow)
    (unit,) = manager.etc.glob("systemd/*/dora-robot.service")
    unit.write_text(unit.read_text().replace(sys.executable, "/nowhere/bin/python"))
    finding = found(manager, scope)["boot"]
    assert finding.text == "robot cannot start at boot: /nowhere/bin/python does not exist"
    start = f"doractl start --enable --name robot '{flow}'"
    assert finding.remedy == f"doractl stop robot, then {start}"


def test_an_enabled_dataflow_where_the_caller_may_not_look(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only root and their user reach the files of a release of the system."""
    place(manager, make_plan(scope), want_boot=True)
    real = os.open

    def refuse(path: Any, *args: Any, **options: Any) -> int:
        if path == "robot.yml":
            raise PermissionError(errno.EACCES, "Permission denied")
        return real(path, *args, **options)

    monkeypatch.setattr(os, "open", refuse)
    assert [one for one in look(manager, scope) if "does not exist" in one.text] == []


@pytest.mark.parametrize(
    ("text", "part"), [("", "starts no dataflow"), (None, "is gone"), (b"\xff", "UTF-8")]
)
def test_an_enabled_unit_that_starts_nothing(
    text: Any, part: str, manager: FakeManager, scope: Scope
) -> None:
    path = manager.etc / "systemd/system/dora-robot.service"
    manager.enable_unit_files(["dora-robot.service"])
    if text is not None:
        path.write_bytes(text or b"")
    finding = found(manager, scope)["boot"]
    assert part in finding.text
    if isinstance(text, str) or text is None:
        assert finding.remedy == "systemctl --system disable dora-robot.service"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "config/dora-systemd/config.yml"
    path.parent.mkdir(parents=True)
    return path


def test_a_half_written_settings_file(manager: FakeManager, scope: Scope, config: Path) -> None:
    path = config
    path.write_text("env: {A: 1\n")
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    assert finding.text.startswith(f"cannot read {path}: line ")
    path.write_text("memory_limt: 1G\n")  # no dataflow would start with that either
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    assert "memory_limt" in finding.text
    path.write_text("memory_limit: 1G\n")
    assert "settings" not in found(manager, scope)


def test_a_settings_file_that_leads_nowhere(
    manager: FakeManager, scope: Scope, config: Path
) -> None:
    config.symlink_to("gone.yml")
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    assert finding.text == f"cannot read {config}: it is a link that leads to no readable file"


def test_a_settings_file_with_a_user_that_no_start_can_have(
    manager: FakeManager, scope: Scope, config: Path
) -> None:
    config.write_text("user: 4000000000\n")
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    fault = (
        "choose the user of a dataflow with --user" if scope.is_user else "find a user '4000000000'"
    )
    assert finding.text == f"cannot {fault} (user in {config})"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a file of somebody else")
def test_a_settings_file_that_root_would_not_believe(
    manager: FakeManager, scope: Scope, config: Path
) -> None:
    config.write_text("user: root\n")
    os.chown(config, 1, 1)
    assert "the file is not root's" in found(manager, scope)["settings"].text


def test_a_broken_unit(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="inactive", LoadState="bad-setting")
    finding = found(manager, scope)["units"]
    assert finding.text == "dora-robot.service cannot be loaded: bad-setting"


def test_dora(
    manager: FakeManager, scope: Scope, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_dora(tmp_path / "bin/dora", "1.0.1")
    assert found(manager, scope)["dora"].state is State.NOTE
    (tmp_path / "bin/dora").unlink()
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{tmp_path}/journal")
    assert found(manager, scope)["dora"].state is State.PROBLEM


def test_linger(manager: FakeManager, tmp_path: Path) -> None:
    user = ScopeIn(is_user=True, uid=0, root=tmp_path / "run")
    make_program(tmp_path / "bin/loginctl", "echo no")
    finding = found(manager, user)["linger"]
    assert finding.remedy == "as root: loginctl enable-linger root"
    make_program(tmp_path / "bin/loginctl", "echo yes")
    assert "linger" not in found(manager, user)


def test_without_cgroup_v2_nothing_starts(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> str:
        raise DoraSystemdError("cannot find the cgroup v2 hierarchy", "", ExitCode.NO_SYSTEMD)

    monkeypatch.setattr(manager, "control_group", fail)
    assert "cannot find the cgroup v2" in found(manager, scope)["cgroup"].text
    assert found(manager, scope)["cgroup"].state is State.PROBLEM


def test_what_a_check_has_found_before_it_fails_is_told(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    def judge_doors(*_: object) -> Iterator[Finding]:
        yield Finding("front", State.WARNING, "it is open")
        raise DoraSystemdError("cannot look at the other door")

    told = {one.topic: one for one in guarded(judge_doors, manager, scope, tmp_path)}
    assert told["front"].text == "it is open"
    assert told["doors"].text == "cannot look at the other door"
