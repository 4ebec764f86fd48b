"""`doractl set` with several changes."""

from pathlib import Path

import pytest

from dora_systemd.cli import main
from dora_systemd.errors import ExitCode
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import FakeManager, options, with_texts


@pytest.mark.parametrize(
    ("active", "flags", "status"),
    [
        ("active", ["--record", "last=soon"], ExitCode.USAGE),
        ("failed", ["--record", "off"], ExitCode.NOT_RUNNING),
        ("failed", ["--hot-reload", "off"], ExitCode.NOT_RUNNING),
    ],
)
def test_nothing_is_changed_if_one_change_cannot_be(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    active: str,
    flags: list[str],
    status: ExitCode,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (fake_cgroups(monkeypatch, tmp_path) / "cgroup.controllers").write_text("memory")
    manager = FakeManager()
    manager.add(options(), active=active, FragmentPath=str(tmp_path / "dora-robot.service"))
    fake_systemd(monkeypatch, manager)
    assert main.run(["--user", "set", "robot", "--memory-limit", "6G", *flags]) == status
    assert manager.calls == []
    assert [one.name for one in tmp_path.iterdir()] == ["cgroup"]


def test_limits_stay_if_the_runner_refuses_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the runner knows the outputs of a dataflow that runs."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (fake_cgroups(monkeypatch, tmp_path) / "cgroup.controllers").write_text("memory")
    manager = FakeManager()
    recording = with_texts(options(), "record=last=10s,memory=10M")
    manager.add(recording, FragmentPath=str(tmp_path / "dora-robot.service"))
    fake_systemd(monkeypatch, manager)
    words = ["set", "robot", "--memory-limit", "6G", "--record", "outputs=camera/nope"]
    assert main.run(["--user", *words]) != ExitCode.OK
    assert capsys.readouterr().out == ""
    assert "record" not in str([*tmp_path.rglob("*.conf")])
