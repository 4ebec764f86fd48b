"""Dataflows whose start systemd holds."""

from pathlib import Path

import pytest

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.views.dataflows import format_dataflows
from dora_systemd.decisions.views.objects import dataflow_object
from dora_systemd.decisions.why.report import format_report
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import read_cell, read_cells
from dora_systemd.verbs.facts.list import table_rows
from dora_systemd.verbs.list import read_whole_rows
from dora_systemd.verbs.start.needs import held_notes
from dora_systemd.verbs.top import Top
from dora_systemd.verbs.why import explain
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import FakeManager, options

UNIT = "dora-robot.service"
HELD = {"JobType": "start", "Job": [7, "/job"], "Awaited": ["network-online.target"]}


def hold(manager: FakeManager, fragment: Path) -> int:
    """A dataflow that waits for the network; since when, CLOCK_REALTIME µs."""
    fragment.touch()
    manager.add(options(), active="inactive", FragmentPath=str(fragment), **HELD)
    return fragment.stat().st_mtime_ns // 1000


def test_all_who_look_know_it(manager: FakeManager, scope: Scope, tmp_path: Path) -> None:
    since = hold(manager, tmp_path / UNIT)
    cells = read_cells(manager)
    (listed,) = read_whole_rows(manager, scope, cells)
    (line,) = table_rows(manager, scope, cells)
    (entry,) = Top(manager, scope).look().entries
    for row in (listed, line, entry.row):
        assert (row.status, row.needs, row.waits_since) == ("Waiting", "network", since)
        assert row.text.startswith("the start waits for network since 20")
    assert "the start waits for network" in format_dataflows([line])
    assert dataflow_object(listed)["waits_for"] == "network"
    assert [*held_notes(manager, "robot")] == ["the start waits for network"]


def test_a_unit_alone_is_read_with_its_job(manager: FakeManager, tmp_path: Path) -> None:
    hold(manager, tmp_path / UNIT)
    cell = read_cell(manager, UNIT)
    assert cell is not None
    assert (cell.is_up, cell.has_begun) == (True, False)


def test_a_start_that_waits_for_nothing_begins(manager: FakeManager, scope: Scope) -> None:
    manager.add(options(), active="inactive", **{**HELD, "Awaited": []})
    (row,) = read_whole_rows(manager, scope, read_cells(manager))
    assert (row.status, row.text) == ("Starting", "")


@pytest.mark.parametrize(("active", "job"), [("inactive", "stop"), ("active", "restart")])
def test_other_jobs_hold_no_start(manager: FakeManager, active: str, job: str) -> None:
    manager.add(options(), active=active, JobType=job)
    (cell,) = read_cells(manager)
    assert not cell.state.is_held


def test_why_says_it_and_how_the_last_life_ended(
    manager: FakeManager, scope: Scope, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold(manager, tmp_path / UNIT)
    message = EVENTS["dataflow-finished"].message_id
    finished = life_record("dataflow-finished", 1, MESSAGE_ID=message, INVOCATION_ID="1")
    FakeJournal(monkeypatch, tmp_path).write(finished)
    shown = format_report(explain(manager, scope, "robot", JournalReader()))
    assert shown.startswith("robot: Waiting\n  Now:      the start waits for network since ")
    assert "Before:   all nodes ended by themselves" in shown
