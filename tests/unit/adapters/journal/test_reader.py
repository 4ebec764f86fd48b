"""journalctl as a child process, played by a script."""

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal.reader import (
    Bounds,
    JournalReader,
    LastEvent,
    check_readable,
    later_failures,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from tests.unit.fakes.library import fake_journalctl
from tests.unit.fakes.manager import UUID
from tests.unit.fakes.programs import make_program

SYSTEM = Scope(is_user=False, uid=0)
USER = Scope(is_user=True, uid=1000)
READY = '{"DORA_NODE":"a","DORA_EVENT":"node-ready"}'
ANY = '{"MESSAGE":"x"}'
ENDED = "550e8400-e29b-41d4-a716-446655440000"
OTHER = ENDED[:-1] + "1"
STOPPED = LastEvent("robot", ENDED, "dataflow-stopped", 20, "", "s=aa;i=1f;b=bb")


@pytest.fixture
def journalctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A script that is found as journalctl."""
    script = tmp_path / "bin" / "journalctl"
    script.parent.mkdir()
    monkeypatch.setenv("PATH", f"{script.parent}:/usr/bin:/bin")
    return script


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
        (
            "Data from the specified boot (-5) is not available: No such boot ID in journal",
            "cannot find the boot: Data from the specified boot (-5) is not available: "
            "No such boot ID in journal",
            ExitCode.NOT_FOUND,
        ),
        (
            "Please specify either --reverse or --follow, not both.",
            "cannot read the journal so: Please specify either --reverse or --follow, not both.",
            ExitCode.USAGE,
        ),
        (
            "--since= must be before --until=.",
            "cannot read the journal so: --since= must be before --until=.",
            ExitCode.USAGE,
        ),
        ("Something else", "cannot read the journal: Something else", ExitCode.FAILURE),
    ],
)
def test_complaints(journalctl: Path, complaint: str, message: str, code: ExitCode) -> None:
    make_program(journalctl, f"echo 'Hint: x' >&2; echo '{complaint}' >&2; exit 1")
    with pytest.raises(DoraSystemdError) as caught:
        JournalReader().known_names(SYSTEM)
    assert (caught.value.message, caught.value.code) == (message, code)


def test_many_complaints_stop_nothing(journalctl: Path) -> None:
    """Of damaged files; a pipe would be full before anybody reads it."""
    many = "head -c 200000 /dev/zero | tr '\\0' '\\n' >&2"
    make_program(journalctl, f"{many}; echo robot; echo 'Something else' >&2; exit 1")
    with pytest.raises(DoraSystemdError, match=r"^cannot read the journal: Something else$"):
        JournalReader().known_names(SYSTEM)


def test_a_notice_is_no_complaint(journalctl: Path) -> None:
    notice = "      Pass -q to turn off this notice."
    make_program(journalctl, f"echo 'Hint: only your own' >&2; echo '{notice}' >&2; exit 1")
    assert JournalReader().known_names(SYSTEM) == []


def test_no_journalctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DoraSystemdError) as caught:
        JournalReader().known_names(SYSTEM)
    assert caught.value.code is ExitCode.NO_SYSTEMD


def play_fields(script: Path, fields: dict[str, list[str]], records: dict[str, str]) -> None:
    """fields: values for --field. records: the output for the matches that end so."""
    cases = [
        f"*--field={field}*) printf '%s\\n' {' '.join(map(shlex.quote, values))};;"
        for field, values in fields.items()
    ]
    cases += [f"*'{matches}') echo '{text}';;" for matches, text in records.items()]
    make_program(
        script, f"""echo "$*" >>'{script}.asked'; case "$*" in\n""" + "\n".join(cases) + "\nesac"
    )


def test_nodes(journalctl: Path) -> None:
    own = "-- _SYSTEMD_UNIT=dora-robot.service"
    names = ["robot", "robot/b", "robot/a", "robot/forged", "robot2/c", "systemd", "robot/a\x1b"]
    records = {f"{own} DORA_EVENT=node-ready": READY, f"{own} DORA_NODE=b": ANY}
    play_fields(journalctl, {"SYSLOG_IDENTIFIER": names}, records)
    assert JournalReader().known_nodes(SYSTEM, "robot") == ["a", "b"]


def test_names_come_from_what_journald_says(journalctl: Path) -> None:
    """Anybody can write a DORA_DATAFLOW_NAME; the system's units are root's."""
    units = ["dora-robot.service", "dora-gateway.service", "ssh.service", "dora-a b.service"]
    forged = ["a", "x1", "x2"]
    fields = {"_SYSTEMD_UNIT": [*units, "x"], "DORA_DATAFLOW_NAME": forged}
    play_fields(journalctl, fields, {})
    assert JournalReader().known_names(SYSTEM) == ["robot"]


def test_names_of_a_user(journalctl: Path) -> None:
    """Another user can have a unit of the same form."""
    units = [f"dora-{name}.service" for name in ("arm", "other", "robot")]
    event = {"DORA_DATAFLOW_NAME": "robot", "_SYSTEMD_USER_UNIT": units[2]}
    records = {
        "DORA_EVENT=dataflow-starting": json.dumps(event),
        f"-- _SYSTEMD_USER_UNIT={units[0]} _UID=1000": ANY,
    }
    play_fields(journalctl, {"_SYSTEMD_USER_UNIT": units}, records)
    assert JournalReader().known_names(USER) == ["arm", "robot"]


def test_no_flood_of_forged_names_takes_long(journalctl: Path) -> None:
    many = [f"robot/x{number}" for number in range(2000)]
    play_fields(journalctl, {"SYSLOG_IDENTIFIER": many}, {"DORA_EVENT=node-ready": READY})
    assert JournalReader().known_nodes(SYSTEM, "robot") == ["a"]
    assert len(Path(f"{journalctl}.asked").read_text().splitlines()) == 23


def test_forged_names_hide_no_node(journalctl: Path) -> None:
    """Neither one that has failed before it was ready, nor one that is looked for."""
    own = "-- _SYSTEMD_UNIT=dora-robot.service"
    many = [*(f"robot/x{number}" for number in range(2000)), "robot/y", "robot/z"]
    records = {
        f"{own} DORA_EVENT=node-exited DORA_EVENT=node-crashed DORA_EVENT=node-ended "
        "DORA_EVENT=node-oom": json.dumps({"DORA_NODE": "z"}),
        f"{own} DORA_NODE=y": ANY,
    }
    play_fields(journalctl, {"SYSLOG_IDENTIFIER": many}, records)
    assert JournalReader().known_nodes(SYSTEM, "robot") == ["z"]
    assert JournalReader().known_nodes(SYSTEM, "robot", ["y", "*", "not-there"]) == ["y", "z"]


def test_killed_nodes(journalctl: Path) -> None:
    found = "".join(
        f'{{"DORA_NODE":"{node}","__REALTIME_TIMESTAMP":"{at}"}}\n'
        for node, at in (("b", 9), ("../x", 8), ("a", 7), ("old", 3))
    )
    own = "_SYSTEMD_UNIT=dora-robot.service DORA_EVENT=node-exited DORA_EXIT=signal SIGKILL"
    play_fields(journalctl, {}, {f"{own} DORA_DATAFLOW={UUID}": found.rstrip()})
    assert JournalReader().killed_since(SYSTEM, "robot", UUID, 5) == ["a", "b"]


def test_a_run(journalctl: Path) -> None:
    play_fields(journalctl, {}, {"-- _SYSTEMD_UNIT=dora-robot.service DORA_RUN=r1": ANY})
    assert JournalReader().has_run(SYSTEM, "robot", "r1")
    assert not JournalReader().has_run(SYSTEM, "robot", "r2")


def test_last_event_of_each_dataflow(journalctl: Path) -> None:
    records = [
        '{"DORA_DATAFLOW":"22222222-2222-2222-2222-222222222222","DORA_DATAFLOW_NAME":"b","_SYSTEMD_UNIT":"dora-b.service","DORA_EVENT":"dataflow-failed",'
        '"DORA_REASON":"daemon lost","__REALTIME_TIMESTAMP":"30"}',
        '{"DORA_DATAFLOW":"11111111-1111-1111-1111-111111111111","DORA_DATAFLOW_NAME":"a","_SYSTEMD_UNIT":"dora-a.service","DORA_EVENT":"dataflow-stopped",'
        '"__REALTIME_TIMESTAMP":"20"}',
        '{"DORA_DATAFLOW":"22222222-2222-2222-2222-222222222222","DORA_DATAFLOW_NAME":"b","_SYSTEMD_UNIT":"dora-b.service","DORA_EVENT":"dataflow-started",'
        '"__REALTIME_TIMESTAMP":"10"}',
    ]
    make_program(journalctl, "cat <<'E'\n" + "\n".join(records) + "\nE")
    first, second = JournalReader().last_events(SYSTEM)
    assert (first.name, first.event, first.detail) == ("b", "dataflow-failed", "daemon lost")
    assert (second.name, second.event, second.at_us) == ("a", "dataflow-stopped", 20)
    assert len(JournalReader().last_events(SYSTEM, limit=1)) == 1


def test_last_event_of_each_name(journalctl: Path) -> None:
    """Of all its runs; and journald says which name a record has."""
    runs = [("a", UUID, 30), ("a", UUID[:-1] + "1", 20), ("b", UUID, 10)]
    records = [
        {
            **{"DORA_DATAFLOW": uuid, "DORA_DATAFLOW_NAME": name, "DORA_EVENT": "dataflow-stopped"},
            **{"_SYSTEMD_UNIT": f"dora-{name}.service", "__REALTIME_TIMESTAMP": f"{at}"},
        }
        for name, uuid, at in runs
    ]
    lines = "\n".join(map(json.dumps, records))
    make_program(journalctl, f"""echo "$@" >'{journalctl}.asked'; cat <<'E'\n{lines}\nE""")
    found = JournalReader().last_events(SYSTEM, is_by_name=True)
    assert [(one.name, one.at_us) for one in found] == [("a", 30), ("b", 10)]
    assert len(JournalReader().last_events(SYSTEM)) == 3
    JournalReader().last_events(SYSTEM, limit=1, name="a")
    assert " _SYSTEMD_UNIT=dora-a.service " in Path(f"{journalctl}.asked").read_text()


def test_lives_of_a_unit(journalctl: Path) -> None:
    lines = [f'{{"_SYSTEMD_INVOCATION_ID":"{one}"}}' for one in ("i2", "i2", "i1")]
    make_program(journalctl, "cat <<'E'\n" + "\n".join(lines) + "\nE")
    assert list(JournalReader().invocations(SYSTEM, "robot", "")) == ["i2", "i1"]


def test_count(journalctl: Path) -> None:
    make_program(
        journalctl, 'echo "$@" | grep -q -- "--since=@1.000002 --until=@3.000000" && seq 5'
    )
    assert JournalReader().count_own(1_000_002, 3_000_000) == 5


@pytest.mark.parametrize(
    ("scope", "where", "code", "word"),
    [
        (SYSTEM, "var", ExitCode.NO_PERMISSION, "systemd-journal"),
        (USER, "var", None, ""),
        (USER, "run", ExitCode.NO_PERMISSION, "Storage=persistent"),
        (SYSTEM, "none", ExitCode.NO_SYSTEMD, "systemctl status systemd-journald"),
        (SYSTEM, "no systemd", ExitCode.NO_SYSTEMD, "not booted with systemd"),
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
    if where != "no systemd":
        (tmp_path / "run/systemd/system").mkdir(parents=True)
    if where in ("var", "run"):
        directory = tmp_path / where / "log/journal/machine"
        directory.mkdir(parents=True)
        (directory / "system.journal").touch()
    monkeypatch.setattr("os.access", lambda *_: False)
    if code is None:
        check_readable(scope, tmp_path)
        return
    with pytest.raises(DoraSystemdError) as caught:
        check_readable(scope, tmp_path)
    assert caught.value.code is code
    assert word in caught.value.hint


def test_records_in_the_name_of_others_are_left_out(journalctl: Path) -> None:
    """A node can write any field; the unit that it wrote it in is journald's word."""
    own = {"DORA_DATAFLOW": ENDED, "DORA_EVENT": "dataflow-failed", "__REALTIME_TIMESTAMP": "9"}
    good = {**own, "DORA_DATAFLOW_NAME": "a", "_SYSTEMD_UNIT": "dora-a.service"}
    bad: list[dict[str, object]] = [
        {**own, "DORA_DATAFLOW_NAME": "b", "_SYSTEMD_UNIT": "dora-a.service"},
        {**own, "DORA_DATAFLOW_NAME": "a"},
        {**own, "DORA_DATAFLOW_NAME": ["a", "b"], "_SYSTEMD_UNIT": "dora-a.service"},
        {**own, "DORA_DATAFLOW_NAME": [27, 93], "_SYSTEMD_UNIT": "dora-a.service"},
        {**own, "DORA_DATAFLOW_NAME": "\x1b]0;x", "_SYSTEMD_UNIT": "dora-\x1b]0;x.service"},
        {**good, "DORA_DATAFLOW": "u1"},
        {**good, "DORA_DATAFLOW": None},
        {**good, "DORA_EVENT": ["dataflow-failed"]},
    ]
    lines = "\n".join(map(json.dumps, [*bad, good]))
    make_program(journalctl, f"cat <<'E'\n{lines}\nE")
    (event,) = JournalReader().last_events(SYSTEM)
    assert (event.name, event.uuid) == ("a", ENDED)
    assert JournalReader().name_of(SYSTEM, ENDED) == "a"


def test_a_node_that_writes_the_uuid_of_another_dataflow(journalctl: Path) -> None:
    """journalctl prints both values of the field: systemd has added that of the node's own."""
    own = "44f30e60-107e-41d2-b6a8-b30cefc153ae"
    of_a = {"DORA_DATAFLOW_NAME": "a", "_SYSTEMD_UNIT": "dora-a.service"}
    of_b = {"DORA_DATAFLOW_NAME": "b", "_SYSTEMD_UNIT": "dora-b.service"}
    forged = {**of_b, "DORA_DATAFLOW": [own, ENDED]}
    lines = "\n".join(map(json.dumps, [*[forged] * 200, {**of_a, "DORA_DATAFLOW": ENDED}]))
    make_program(journalctl, f"cat <<'E'\n{lines}\nE")
    assert JournalReader().name_of(SYSTEM, ENDED) == "a"


def test_an_endless_journal_has_an_end(journalctl: Path) -> None:
    make_program(journalctl, """while :; do printf '{"MESSAGE":"%02000d"}\\n' 7; done""")
    assert 0 < len(list(JournalReader(Bounds(1 << 20)).newest([], None))) < 600


def test_a_journal_that_stops_in_the_middle(journalctl: Path) -> None:
    make_program(journalctl, """echo '{"MESSAGE":"x"}'; exec sleep 60""")
    assert list(JournalReader(Bounds(seconds=0.3)).newest([], None)) == [{"MESSAGE": "x"}]


def test_a_record_that_is_too_long_is_left_out(journalctl: Path) -> None:
    long = """printf '{"MESSAGE":"'; head -c 3000000 /dev/zero | tr '\\0' 7; echo '"}'"""
    make_program(journalctl, f"""echo '{{"MESSAGE":"a"}}'; {long}; echo '{{"MESSAGE":"b"}}'""")
    found = [one["MESSAGE"] for one in JournalReader().newest([], None)]
    assert found == ["a", "b"]


def test_values_that_can_be_no_uuids(journalctl: Path) -> None:
    make_program(journalctl, f"printf '%s\\n' robot ../x '\x1b]0;x' 'a b' {ENDED}")
    assert JournalReader().known_uuids() == [ENDED]


def test_a_complaint_of_a_journal_that_is_read_to_a_bound_is_none(journalctl: Path) -> None:
    complaint = "system.journal is truncated, ignoring file."
    make_program(journalctl, f"echo '{complaint}' >&2; exec yes dora-a")
    assert set(JournalReader(Bounds(10_000)).unique("X")) == {"dora-a"}


def test_a_complaint_of_a_journal_that_shows_nothing_is_told(journalctl: Path) -> None:
    make_program(journalctl, "echo 'Failed to wait: x' >&2; exec sleep 1000")
    with pytest.raises(DoraSystemdError, match=r"^cannot read the journal: Failed to wait: x$"):
        JournalReader(Bounds(first_seconds=2.0)).unique("X")


def record(at_us: int, cursor: str = "", uuid: str = ENDED, **more: Any) -> dict[str, Any]:
    """One of systemd."""
    own = {"DORA_DATAFLOW": uuid, "UNIT": "dora-robot.service"}
    return {**own, "__REALTIME_TIMESTAMP": str(at_us), "__CURSOR": cursor, **more}


@pytest.mark.parametrize(
    "found, expected",
    [
        ([record(30), record(25)], {ENDED: 30}),
        ([record(10)], {}),
        ([record(30, uuid=OTHER)], {}),
        ([record(30, UNIT="other.service")], {}),
        ([record(30, DORA_DATAFLOW=[ENDED, OTHER])], {}),
        pytest.param([record(30, "s=aa;i=1e;b=bb")], {}, id="the clock was set back"),
        pytest.param([record(10, "s=aa;i=20;b=bb")], {ENDED: 10}, id="the clock was set forward"),
        pytest.param([record(30, "s=cc;i=1;b=bb")], {ENDED: 30}, id="another journald"),
    ],
)
def test_failures(
    found: list[dict[str, Any]],
    expected: dict[str, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = fake_journalctl(monkeypatch, tmp_path, found)
    assert later_failures([STOPPED]) == expected
    (asked,) = calls.read_text().splitlines()
    failed = "MESSAGE_ID=d9b373ed55a64feb8242e02dbe79a49c"
    assert asked.endswith(f" -- _PID=1 {failed} DORA_DATAFLOW={ENDED}")
