"""Which dataflows `doractl list` shows, and how it prints them."""

import os
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.cli import listing
from dora_systemd.cli.listing import ListRequest
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

OTHER = UUID[:-1] + "1"


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeJournal:
    """Two dataflows that systemd does not know."""
    found = FakeJournal(monkeypatch, tmp_path)
    names = (("old", "dataflow-failed"), ("older", "dataflow-stopped"))
    more: dict[str, Any] = {"scope": Scope(True, 1000), "DORA_REASON": "it broke"}
    found.write(*(life_record(event, 9, name, OTHER, **more) for name, event in names))
    return found


def names(place: Path, **request: Any) -> str:
    """The names that a request shows, of two that run and one that has failed."""
    manager = FakeManager()
    manager.add(options("b-arm"))
    manager.add(options("a"))
    manager.add(options("bad"), "failed", InactiveEnterTimestamp=5, ExecMainStatus=1)
    scope = ScopeIn(is_user=True, uid=1000, root=place)
    rows = listing._rows(manager, scope, ListRequest(**request))
    return " ".join(row.name for row in rows)


def test_what_failed_comes_first(tmp_path: Path) -> None:
    assert names(tmp_path) == "bad a b-arm"


def test_what_runs_needs_no_journal(tmp_path: Path, journal: FakeJournal) -> None:
    assert names(tmp_path, pattern="ARM") == "b-arm"
    assert names(tmp_path, status="running", sort_by="name") == "a b-arm"
    assert journal.asked == []


@pytest.mark.usefixtures("journal")
def test_what_ended_is_below_it(tmp_path: Path) -> None:
    assert names(tmp_path, want_all=True) == "a b-arm old older bad"
    assert names(tmp_path, want_all=True, sort_by="name") == "a b-arm bad old older"
    assert names(tmp_path, last=1) == "a b-arm old"
    assert names(tmp_path, status="failed") == "old bad"
    # The newest of those that match, not those that match of the newest.
    assert names(tmp_path, status="failed", pattern="bad", last=1) == "bad"
    assert names(tmp_path, status="stopped", last=5) == "older"


ROWS = [
    DataflowRow(UUID, "robot", "dora-robot.service", "Running"),
    DataflowRow(OTHER, "old", "dora-old.service", "Failed", text="it broke"),
]


def test_a_pattern_stands_for_all_that_match() -> None:
    assert ListRequest("r*").is_pattern
    assert not ListRequest("robot").is_pattern
    assert listing._fitting(ROWS, ListRequest("r*")) == ROWS[:1]
    assert listing._fitting(ROWS, ListRequest("*o*")) == ROWS
    assert listing._fitting(ROWS, ListRequest()) == ROWS
    listing._check(ListRequest("r*", status="failed"))
    with pytest.raises(DoraSystemdError, match="no dataflow named 'x"):
        listing._fitting(ROWS, ListRequest("x*"))


def test_uuids_alone(capsys: pytest.CaptureFixture[str]) -> None:
    request = ListRequest(is_quiet=True)
    listing._print_all(ROWS, request)
    listing._print_all([], request)
    assert capsys.readouterr().out == f"{UUID}\n{OTHER}\n"


@pytest.mark.parametrize("rows", [ROWS, ROWS[:1]])
def test_a_terminal_says_where_more_is(
    rows: list[DataflowRow], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SYSTEMD_COLORS", raising=False)
    listing._print_all(rows, ListRequest())
    assert capsys.readouterr().out.count("\n") == 1 + len(rows)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    listing._print_all(rows, ListRequest())
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("\x1b[4m")
    assert (shown[-1] == listing._MORE) == (rows is ROWS)
    assert len(listing._MORE) <= 60


def test_a_number_of_columns_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("os.get_terminal_size", lambda: os.terminal_size((99, 24)))
    for columns, width in (("60", 60), ("-5", 99), ("0", 99), ("", 99), ("many", 99)):
        monkeypatch.setenv("COLUMNS", columns)
        assert listing.terminal_width() == width


def test_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    for request in (ListRequest(), ListRequest(want_all=True), ListRequest(pattern="x")):
        listing._print_all([], request)
    assert capsys.readouterr().out == "No dataflow is running.\nNo dataflow.\nNo dataflow.\n"
