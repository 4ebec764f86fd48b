"""journalctl as a child process, played by a script."""

from pathlib import Path

import pytest

from dora_systemd import journalread
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.journalread import JournalReader, check_readable
from dora_systemd.scope import Scope

SYSTEM = Scope(is_user=False, uid=0)
USER = Scope(is_user=True, uid=1000)


@pytest.fixture
def journalctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A script that is found as journalctl."""
    script = tmp_path / "bin" / "journalctl"
    script.parent.mkdir()
    monkeypatch.setenv("PATH", f"{script.parent}:/usr/bin:/bin")
    return script


def play(script: Path, text: str) -> None:
    script.write_text(f"#!/bin/sh\n{text}\n")
    script.chmod(0o755)


@pytest.mark.parametrize(
    ("complaint", "message", "code"),
    [
        ("Failed to parse timestamp: foo", "cannot read the time: foo", ExitCode.USAGE),
        ('Bad pattern "(": missing )', 'cannot use the pattern "(": missing )', ExitCode.USAGE),
        (
            "No journal files were opened due to insufficient permissions.",
            "cannot read the journal",
            ExitCode.NO_PERMISSION,
        ),
        ("Something else", "cannot read the journal: Something else", ExitCode.FAILURE),
    ],
)
def test_complaints(journalctl: Path, complaint: str, message: str, code: ExitCode) -> None:
    play(journalctl, f"echo 'Hint: x' >&2; echo '{complaint}' >&2; exit 1")
    with pytest.raises(DoraSystemdError) as caught:
        JournalReader().known_names()
    assert (caught.value.message, caught.value.code) == (message, code)


def test_a_notice_is_no_complaint(journalctl: Path) -> None:
    notice = "      Pass -q to turn off this notice."
    play(journalctl, f"echo 'Hint: only your own' >&2; echo '{notice}' >&2; exit 1")
    assert JournalReader().known_names() == []


def test_no_journalctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DoraSystemdError) as caught:
        JournalReader().known_names()
    assert caught.value.code is ExitCode.NO_SYSTEMD


def test_nodes(journalctl: Path) -> None:
    play(journalctl, "printf '%s\\n' robot robot/b robot/a robot2/c systemd")
    assert JournalReader().known_nodes("robot") == ["a", "b"]


def test_last_event_of_each_dataflow(journalctl: Path) -> None:
    records = [
        '{"DORA_DATAFLOW":"u2","DORA_DATAFLOW_NAME":"b","DORA_EVENT":"dataflow-failed",'
        '"DORA_REASON":"daemon lost","__REALTIME_TIMESTAMP":"30"}',
        '{"DORA_DATAFLOW":"u1","DORA_DATAFLOW_NAME":"a","DORA_EVENT":"dataflow-stopped",'
        '"__REALTIME_TIMESTAMP":"20"}',
        '{"DORA_DATAFLOW":"u2","DORA_DATAFLOW_NAME":"b","DORA_EVENT":"dataflow-started",'
        '"__REALTIME_TIMESTAMP":"10"}',
    ]
    play(journalctl, "cat <<'E'\n" + "\n".join(records) + "\nE")
    first, second = JournalReader().last_events(SYSTEM)
    assert (first.name, first.event, first.detail) == ("b", "dataflow-failed", "daemon lost")
    assert (second.uuid, second.event, second.at_us) == ("u1", "dataflow-stopped", 20)
    assert len(JournalReader().last_events(SYSTEM, limit=1)) == 1


def test_lives_of_a_unit(journalctl: Path) -> None:
    lines = [f'{{"_SYSTEMD_INVOCATION_ID":"{one}"}}' for one in ("i2", "i2", "i1")]
    play(journalctl, "cat <<'E'\n" + "\n".join(lines) + "\nE")
    assert list(JournalReader().invocations(SYSTEM, "robot", "")) == ["i2", "i1"]


def test_count(journalctl: Path) -> None:
    play(journalctl, 'echo "$@" | grep -q -- "--since=@1.000002 --until=@3.000000" && seq 5')
    assert JournalReader().count_own(1_000_002, 3_000_000) == 5


@pytest.mark.parametrize(
    ("scope", "where", "code", "word"),
    [
        (SYSTEM, "persistent", ExitCode.NO_PERMISSION, "systemd-journal"),
        (USER, "persistent", None, ""),
        (USER, "volatile", ExitCode.NO_PERMISSION, "Storage=persistent"),
        (SYSTEM, "none", ExitCode.NO_SYSTEMD, "journald"),
    ],
)
def test_unreadable(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    scope: Scope,
    where: str,
    code: ExitCode | None,
    word: str,
) -> None:
    for name in ("persistent", "volatile"):
        monkeypatch.setattr(journalread, name.upper(), tmp_path / name)
    if where != "none":
        (tmp_path / where / "machine").mkdir(parents=True)
        (tmp_path / where / "machine" / "system.journal").touch()
    monkeypatch.setattr("os.access", lambda *_: False)
    if code is None:
        check_readable(scope)
        return
    with pytest.raises(DoraSystemdError) as caught:
        check_readable(scope)
    assert caught.value.code is code
    assert word in caught.value.hint
