"""Dataflows that only the journal knows."""

from typing import Any

import pytest

from dora_systemd.adapters.journal.reader import JournalReader, LastEvent
from dora_systemd.decisions.life.causes import NO_END
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts import ended as facts
from dora_systemd.verbs.facts import lives
from dora_systemd.verbs.facts.ended import ended_row, ended_rows, newest_ended, not_recorded
from dora_systemd.verbs.facts.list import read_rows
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


def test_an_error_says_that_the_journal_is_volatile(monkeypatch: pytest.MonkeyPatch) -> None:
    error = DoraSystemdError("no dataflow named 'x'", "did you mean y?", ExitCode.NOT_FOUND)
    monkeypatch.setattr("dora_systemd.verbs.facts.ended.is_volatile", lambda: False)
    assert not_recorded(error) is error
    monkeypatch.setattr("dora_systemd.verbs.facts.ended.is_volatile", lambda: True)
    told = not_recorded(error)
    assert told.message == "no dataflow named 'x', and the journal is volatile: a reboot empties it"
    assert (told.hint, told.code) == (error.hint, error.code)
    other = DoraSystemdError("cannot tell", "", ExitCode.USAGE)
    assert not_recorded(other) is other


class Events:
    """Asked for the last events of the journal, it has these."""

    def __init__(self, *events: LastEvent) -> None:
        self.events = list(events)
        self.asked: list[dict[str, Any]] = []

    def __call__(self, _scope: Scope, **what: Any) -> list[LastEvent]:
        self.asked.append(what)
        return self.events


SCOPE = Scope(is_user=False, uid=0)


@pytest.fixture
def manager() -> FakeManager:
    """Two dataflows that run and have run before, one that failed and one that was stopped."""
    found = FakeManager()
    found.add(options("up"))
    found.add(options("again", OTHER))
    facts = {"InactiveExitTimestamp": 10, "StatusText": "2/2 nodes running", "ExecMainCode": 2}
    found.add(options("bad", OTHER), "failed", InactiveEnterTimestamp=20, ExecMainStatus=9, **facts)
    found.add(options("still"), "inactive", InactiveEnterTimestamp=40)
    return found


def ended(
    manager: FakeManager,
    journal: Events,
    limit: int | None = None,
    failures: dict[str, int] | None = None,
) -> list[DataflowRow]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(JournalReader, "last_events", lambda _self, *one, **two: journal(*one, **two))
        patch.setattr(facts, "later_failures", lambda _events: failures or {})
        # This machine may have a journal, with dataflows of these names in it.
        patch.setattr(lives, "read_lives", lambda *_one, **_two: [])
        return newest_ended(manager, SCOPE, read_rows(manager, SCOPE), limit)


def test_one_row_for_each_name_that_does_not_run(manager: FakeManager) -> None:
    journal = Events(
        LastEvent("up", UUID, "dataflow-started", 50, ""),
        LastEvent("again", UUID, "dataflow-failed", 45, "an earlier one"),
        LastEvent("gone", UUID, "dataflow-stopped", 30, ""),
        LastEvent("bad", OTHER, "dataflow-failed", 19, "node a: exit code 1"),
        LastEvent("old", UUID, "dataflow-starting", 5, ""),
    )
    rows = ended(manager, journal)
    assert [(row.name, row.status, row.ended) for row in rows] == [
        *(("still", "Stopped", 40), ("gone", "Stopped", 30), ("bad", "Failed", 20)),
        ("old", "Failed", 5),
    ]
    assert rows[2].text == "node a: exit code 1"
    assert [row.name for row in ended(manager, journal, 2)] == ["still", "gone"]
    # Names that systemd has loaded are among those in the journal.
    assert [one["limit"] for one in journal.asked] == [104, 6]
    assert all(one["is_by_name"] for one in journal.asked)


@pytest.mark.parametrize(
    "event",
    [
        LastEvent("bad", UUID, "dataflow-failed", 19, "another one of that name"),
        LastEvent("bad", OTHER, "dataflow-failed", 9, "an earlier run of it"),
        LastEvent("bad", OTHER, "dataflow-started", 19, "no end"),
    ],
)
def test_an_end_that_is_only_known_to_systemd(manager: FakeManager, event: LastEvent) -> None:
    (row,) = [row for row in ended(manager, Events(event)) if row.name == "bad"]
    assert (row.text, row.ended) == ("2/2 nodes running (signal SIGKILL)", 20)


def test_an_enabled_one_that_systemd_has_loaded_again(manager: FakeManager) -> None:
    manager.add(options("still"), "inactive", InactiveEnterTimestamp=0)
    event = LastEvent("still", UUID, "dataflow-stopped", 60, "")
    assert [row.ended for row in ended(manager, Events(event))] == [60, 20]


def test_a_start_that_failed_before_it_recorded_anything(manager: FakeManager) -> None:
    """Our last event is of the run before it, which was stopped, as by a restart."""
    journal = Events(
        LastEvent("gone", UUID, "dataflow-stopped", 30, ""),
        LastEvent("done", OTHER, "dataflow-finished", 20, ""),
    )
    rows = {row.name: row for row in ended(manager, journal, failures={UUID: 31})}
    assert (rows["gone"].status, rows["gone"].ended) == ("Failed", 31)
    assert rows["gone"].text == NO_END
    assert (rows["done"].status, rows["done"].ended) == ("Finished", 20)


def test_nothing_says_whose_failure_it_is_to_a_user(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [row.status for row in told(monkeypatch, Scope(True, 1000))] == ["Stopped"]


def test_failures_that_cannot_be_read_hide_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [row.status for row in told(monkeypatch, SCOPE)] == ["Stopped"]


def told(monkeypatch: pytest.MonkeyPatch, scope: Scope) -> list[DataflowRow]:
    """The rows of one that was stopped, without its failures."""

    def fail(_events: object) -> dict[str, int]:
        raise DoraSystemdError("cannot read the journal")

    event = LastEvent("gone", UUID, "dataflow-stopped", 30, "")
    monkeypatch.setattr(JournalReader, "last_events", lambda _self, _scope: [event])
    monkeypatch.setattr(facts, "later_failures", fail)
    return ended_rows(scope)
