"""doctor against a fake systemd, and without any."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.host.process import Completed
from dora_systemd.adapters.journal import reader as journal_reader
from dora_systemd.decisions.gateway.place import SOCKET_UNIT
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.views.real_time import RealTime
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs import doctor
from dora_systemd.verbs.doctor import examine
from dora_systemd.verbs.start import logins
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.verbs.start.test_claim import make_plan, place


@pytest.fixture
def manager(manager: FakeManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeManager:
    """A machine where all is well."""
    manager.units["dora.target"] = {"LoadState": "loaded", "WantedBy": ["multi-user.target"]}
    (tmp_path / "cgroup").mkdir()
    (tmp_path / "cgroup/cgroup.controllers").write_text("cpu cpuset io memory pids\n")
    monkeypatch.setattr(cgroup, "mount_point", lambda: tmp_path / "cgroup")
    monkeypatch.setattr(journal_reader, "check_readable", lambda _scope: None)
    monkeypatch.setattr(journal_reader, "is_volatile", lambda: False)
    monkeypatch.setattr(doctor, "run_command", lambda *_: Completed(0, "", ""))
    monkeypatch.setattr(doctor, "find_dora", lambda *_: "/bin/dora")
    monkeypatch.setattr(doctor, "dora_version", lambda _dora: "1.1.0")
    monkeypatch.setattr(doctor, "DEFAULT_USER", "root")
    monkeypatch.setattr(doctor, "config_files", lambda _: [])
    monkeypatch.setattr(doctor, "read_processes", list)
    monkeypatch.setattr(doctor, "read_real_time", RealTime)
    monkeypatch.setattr(logins, "_logins", lambda _passwd: [])
    monkeypatch.setattr(doctor, "listening_sockets", lambda _port: frozenset())
    return manager


def found(manager: FakeManager, scope: Scope) -> dict[str, Finding]:
    """The last finding of each topic that is not as it should be."""
    findings = examine(lambda _scope: manager, scope)
    return {one.topic: one for one in findings if one.state is not State.OK}


def test_all_is_well(manager: FakeManager, scope: Scope) -> None:
    findings = examine(lambda _scope: manager, scope)
    assert {one.state for one in findings} == {State.OK}
    assert {one.topic for one in findings} == {
        *("systemd", "cgroup", "boot", "left over", "journal", "log rate", "dora", "user"),
        *("port 6013", "port 53290", "bare dora", "real time", "cpuset"),
    }
    assert not any(one.remedy for one in findings)


def test_its_own_gateway_is_no_stranger(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "listening_sockets", lambda _port: frozenset({7}))
    monkeypatch.setattr(doctor, "socket_owners", lambda _sockets: frozenset())
    assert {"port 6013", "port 53290"} <= found(manager, scope).keys()
    facts = {"LoadState": "loaded", "ActiveState": "active"}
    manager.units[SOCKET_UNIT] = {**facts, "Listen": [["Stream", "127.0.0.1:53290"]]}
    assert "port 53290" not in found(manager, scope)
    assert "port 6013" in found(manager, scope)


def test_without_systemd(manager: FakeManager, scope: Scope) -> None:
    def reach(_scope: Scope) -> FakeManager:
        raise DoraSystemdError("cannot reach systemd", "boot with it", ExitCode.NO_SYSTEMD)

    del manager
    first, *rest = examine(reach, scope)
    assert first == Finding("systemd", State.PROBLEM, "cannot reach systemd", "boot with it")
    assert {one.topic for one in rest} >= {"journal", "dora", "bare dora"}


def test_what_ended_dataflows_have_left(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    manager.add(options())
    for name in ("robot", "ghost"):
        scope.cell_directory(name).mkdir(parents=True)
        group = tmp_path / f"cgroup/dora.slice/dora-{name}.service"
        group.mkdir(parents=True)
        (group / "cgroup.events").write_text("populated 1\n")
    findings = examine(lambda _scope: manager, scope)
    left = [one for one in findings if one.topic == "left over"]
    assert [one.state for one in left] == [State.WARNING] * 2
    assert left[0].remedy == f"rm -r {scope.cell_directory('ghost')}"
    assert left[1].remedy.endswith("dora-ghost.service/cgroup.kill")


def test_an_enabled_dataflow_that_systemd_has_lost(
    manager: FakeManager, scope: Scope, tmp_path: Path
) -> None:
    plan = make_plan(scope)
    flow = tmp_path / "robot.yml"
    flow.touch()
    plan = replace(plan, options=plan.options._replace(dataflow=str(flow)))
    place(manager, plan, want_boot=True)
    (finding,) = found(manager, scope).values()
    assert finding.text == "dora-robot.service is enabled and systemd does not know it"
    assert finding.remedy == "systemctl --system daemon-reload"


def test_an_enabled_dataflow_whose_file_is_gone(manager: FakeManager, scope: Scope) -> None:
    place(manager, make_plan(scope), want_boot=True)
    (finding,) = found(manager, scope).values()
    assert finding.text == "robot is enabled, but /srv/robot.yml does not exist"
    assert finding.remedy == "doractl disable robot"


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


def test_a_half_written_settings_file(
    manager: FakeManager, scope: Scope, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config.yml"
    path.write_text("env: {A: 1\n")
    monkeypatch.setattr(doctor, "config_files", lambda _: [path])
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    assert finding.text.startswith(f"cannot read {path}: line ")
    path.write_text("memory_limt: 1G\n")  # no dataflow would start with that either
    finding = found(manager, scope)["settings"]
    assert finding.state is State.PROBLEM
    assert "memory_limt" in finding.text
    path.write_text("memory_limit: 1G\n")
    assert "settings" not in found(manager, scope)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a file of somebody else")
def test_a_settings_file_that_root_would_not_believe(
    manager: FakeManager, scope: Scope, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config.yml"
    monkeypatch.setattr(doctor, "config_files", lambda _: [path])
    path.write_text("user: root\n")
    os.chown(path, 1, 1)
    assert "the file is not root's" in found(manager, scope)["settings"].text


def test_a_broken_unit(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="inactive", LoadState="bad-setting")
    finding = found(manager, scope)["units"]
    assert finding.text == "dora-robot.service cannot be loaded: bad-setting"


def test_dora(manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "dora_version", lambda _dora: "1.0.1")
    assert found(manager, scope)["dora"].state is State.NOTE

    def fail(*_: object) -> str:
        raise DoraSystemdError("cannot find the dora command", "install it", ExitCode.NO_DORA)

    monkeypatch.setattr(doctor, "find_dora", fail)
    assert found(manager, scope)["dora"].state is State.PROBLEM


def test_linger(manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    user = ScopeIn(is_user=True, uid=0, root=tmp_path)
    monkeypatch.setattr(doctor, "is_lingering", lambda _scope: False)
    finding = found(manager, user)["linger"]
    assert finding.remedy == "as root: loginctl enable-linger root"
    monkeypatch.setattr(doctor, "is_lingering", lambda _scope: True)
    assert "linger" not in found(manager, user)


def test_a_check_that_fails_is_a_finding(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> Path:
        raise DoraSystemdError("cannot find the cgroup v2 hierarchy", "", ExitCode.NO_SYSTEMD)

    monkeypatch.setattr(cgroup, "mount_point", fail)
    assert "cannot find the cgroup v2" in found(manager, scope)["controllers"].text


def test_what_a_check_has_found_before_it_fails_is_told(
    manager: FakeManager, scope: Scope, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judge_doors(*_: object) -> Iterator[Finding]:
        yield Finding("front", State.WARNING, "it is open")
        raise DoraSystemdError("cannot look at the other door")

    monkeypatch.setattr(doctor, "_WITH_SYSTEMD", (judge_doors,))
    told = found(manager, scope)
    assert told["front"].text == "it is open"
    assert told["doors"].text == "cannot look at the other door"
