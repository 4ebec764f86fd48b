"""Dataflows that only the journal knows."""

from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.journal.reader import LastEvent
from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.report import Subject
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.ended import ended_row, ended_rows, newest_ended, not_recorded
from dora_systemd.verbs.facts.list import read_rows
from dora_systemd.verbs.why import subject_row
from tests.unit.fakes.journal import FakeJournal, failure_record, life_record
from tests.unit.fakes.manager import UUID, FakeManager, options

OTHER = UUID[:-1] + "1"


@pytest.mark.parametrize(
    ("event", "word", "text"),
    [
        ("dataflow-finished", "Finished", "detail"),
        ("dataflow-stopped", "Stopped", "detail"),
        ("dataflow-failed", "Failed", "detail"),
        ("dataflow-started", "Failed", "its end is not recorded"),
    ],
)
def test_rows(event: str, word: str, text: str) -> None:
    row = ended_row(LastEvent("robot", UUID, event, 17, "detail"))
    assert (row.name, row.unit, row.uuid) == ("robot", "dora-robot.service", UUID)
    assert (row.status, row.ended) == (word, 17)
    assert row.text.startswith(text)


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeJournal:
    return FakeJournal(monkeypatch, tmp_path)


def test_an_error_says_that_the_journal_is_volatile(journal: FakeJournal) -> None:
    error = DoraSystemdError("no dataflow named 'x'", "did you mean y?", ExitCode.NOT_FOUND)
    assert not_recorded(error) is error
    (journal.directory / "system.journal").unlink()
    told = not_recorded(error)
    assert told.message == "no dataflow named 'x', and the journal is volatile: a reboot empties it"
    assert (told.hint, told.code) == (error.hint, error.code)
    other = DoraSystemdError("cannot tell", "", ExitCode.USAGE)
    assert not_recorded(other) is other


SCOPE = Scope(is_user=False, uid=0)


@pytest.fixture
def manager() -> FakeManager:
    """Two dataflows that run and have run before, one that failed and one that was stopped."""
    found = FakeManager()
    found.add(options("up"))
    found.add(options("again", OTHER))
    facts: dict[str, Any] = {"InactiveExitTimestamp": 10, "InactiveEnterTimestamp": 20}
    facts |= {"StatusText": "2/2 nodes running", "Result": "signal"}
    found.add(options("bad", OTHER), "failed", ExecMainCode=2, ExecMainStatus=9, **facts)
    found.add(options("still"), "inactive", InactiveEnterTimestamp=40)
    return found


def ended(manager: FakeManager, limit: int | None = None) -> list[DataflowRow]:
    return newest_ended(manager, SCOPE, read_rows(manager, SCOPE), limit)


def test_one_row_for_each_name_that_does_not_run(
    manager: FakeManager, journal: FakeJournal
) -> None:
    journal.write(
        life_record("dataflow-started", 50, "up"),
        life_record("dataflow-failed", 45, "again", DORA_REASON="an earlier one"),
        life_record("dataflow-stopped", 30, "gone"),
        life_record("dataflow-stopped", 29, "gone", OTHER),
        life_record("dataflow-failed", 19, "bad", OTHER, DORA_REASON="node a: exit code 1"),
        life_record("dataflow-starting", 5, "old"),
    )
    rows = ended(manager)
    assert [(row.name, row.status, row.ended) for row in rows] == [
        *(("still", "Stopped", 40), ("gone", "Stopped", 30), ("bad", "Failed", 20)),
        ("old", "Failed", 5),
    ]
    assert rows[2].text == "node a: exit code 1"
    # Names that systemd has loaded are among those in the journal.
    assert [row.name for row in ended(manager, 2)] == ["still", "gone"]


def test_a_node_that_fills_the_journal_hides_no_other(journal: FakeJournal) -> None:
    """It can write life events of its own dataflow, with any fields in addition."""
    full = life_record("dataflow-started", 50, "full", MORE="x" * 900_000)
    journal.write(*[full] * 50, life_record("dataflow-stopped", 30, "gone", OTHER))
    assert [row.name for row in ended_rows(SCOPE)] == ["full", "gone"]


def test_a_node_that_forges_more_events_than_are_read_hides_no_other(journal: FakeJournal) -> None:
    forged = life_record("dataflow-failed", 50, "full", DORA_REASON="x" * 500_000)
    journal.write(*[forged] * 80, life_record("dataflow-stopped", 30, "gone", OTHER))
    assert [row.name for row in ended_rows(SCOPE)] == ["full", "gone"]


@pytest.mark.parametrize(
    ("began", "result", "shown"),
    [
        (30, "exit-code", ("Failed", "node a: exit code 1", 40)),
        (39, "success", ("Stopped", "", 40)),
    ],
    ids=["no later life", "it was started again, and stopped"],
)
def test_a_stop_that_calls_a_restart_off_leaves_it_failed(
    manager: FakeManager,
    journal: FakeJournal,
    began: int,
    result: str,
    shown: tuple[str, str, int],
) -> None:
    """systemd calls it inactive then, as after any stop, and since 39 it waited to restart it."""
    facts = {"ExecMainStartTimestamp": began, "InactiveExitTimestamp": 39, "Result": result}
    manager.add(options("still"), "inactive", InactiveEnterTimestamp=40, **facts)
    journal.write(life_record("dataflow-failed", 35, "still", DORA_REASON="node a: exit code 1"))
    (row,) = (row for row in ended(manager) if row.name == "still")
    assert (row.status, row.text, row.ended) == shown


def test_a_stop_that_killed_is_no_failure(manager: FakeManager, journal: FakeJournal) -> None:
    def record(event: str, at_us: int, invocation: str, **fields: Any) -> dict[str, object]:
        fields |= {"MESSAGE_ID": EVENTS[event].message_id, "_SYSTEMD_INVOCATION_ID": invocation}
        return life_record(event, at_us, "gone", **fields)

    journal.write(
        record("dataflow-failed", 32, "1", DORA_REASON=BY_SIGKILL, DORA_CAUSE="runner-killed"),
        record("stop-asked", 31, "session", DORA_BY="root (doractl stop)"),
        record("dataflow-started", 30, "1"),
    )
    (row,) = (row for row in ended(manager) if row.name == "gone")
    assert (row.status, row.text) == ("Stopped", "stopped by root (doractl stop); killed")
    of_report = subject_row(manager, SCOPE, Subject(UUID, "gone", row.unit, "--system"))
    assert (of_report.status, of_report.text) == (row.status, row.text)


@pytest.mark.parametrize(
    "event",
    [
        life_record("dataflow-failed", 19, "bad", DORA_REASON="another one of that name"),
        life_record("dataflow-failed", 9, "bad", OTHER, DORA_REASON="an earlier run of it"),
        life_record("dataflow-started", 19, "bad", OTHER),
    ],
)
def test_an_end_that_is_only_known_to_systemd(
    manager: FakeManager, journal: FakeJournal, event: dict[str, object]
) -> None:
    journal.write(event)
    (row,) = [row for row in ended(manager) if row.name == "bad"]
    assert (row.text, row.ended) == ("signal SIGKILL", 20)


def test_an_enabled_one_that_systemd_has_loaded_again(
    manager: FakeManager, journal: FakeJournal
) -> None:
    manager.add(options("still"), "inactive", InactiveEnterTimestamp=0)
    journal.write(life_record("dataflow-stopped", 60, "still"))
    assert [row.ended for row in ended(manager)] == [60, 20]


def test_a_start_that_failed_before_it_recorded_anything(
    manager: FakeManager, journal: FakeJournal
) -> None:
    """Our last event is of the run before it, which was stopped, as by a restart."""
    journal.write(
        failure_record(31, "gone", UUID),
        life_record("dataflow-stopped", 30, "gone"),
        life_record("dataflow-finished", 20, "done", OTHER),
    )
    rows = {row.name: row for row in ended(manager)}
    assert (rows["gone"].status, rows["gone"].ended) == ("Failed", 31)
    assert rows["gone"].text == "the unit failed: systemd does not say how"
    assert (rows["done"].status, rows["done"].ended) == ("Finished", 20)


def test_nothing_says_whose_failure_it_is_to_a_user(journal: FakeJournal) -> None:
    user = Scope(True, 1000)
    stopped = life_record("dataflow-stopped", 30, "gone", scope=user)
    journal.write(failure_record(31, "gone", UUID), stopped)
    assert [row.status for row in ended_rows(user)] == ["Stopped"]


def test_failures_that_cannot_be_read_hide_no_row(journal: FakeJournal) -> None:
    journal.write(life_record("dataflow-stopped", 30, "gone"))
    journal.complain("Something else", "_PID=1")
    assert [row.status for row in ended_rows(SCOPE)] == ["Stopped"]
