"""What is known of a dataflow beside its table: the boot, and the restarts left."""

from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.logs.query import UNIT_STARTING
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.why.report import Subject
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.budget import _starts
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import mark_enabled
from dora_systemd.verbs.list import read_whole_rows
from dora_systemd.verbs.top import Top, read_snapshot
from dora_systemd.verbs.why import subject_row
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, options

UNIT = "dora-robot.service"
POLICY: dict[str, Any] = {
    "Restart": "on-failure",
    "StartLimitBurst": 6,
    "StartLimitIntervalUSec": 600 * SECOND,
}
NEVER_YET = {"used": 0, "max": 5, "next_us": None, "resets_us": None}


@pytest.fixture
def enabled(manager: FakeManager) -> FakeManager:
    """The dataflow robot, which runs, has a restart policy, and starts at boot."""
    wants = manager.etc / "systemd/system/dora.target.wants"
    wants.mkdir(parents=True)
    (wants / UNIT).symlink_to(Path("..") / UNIT)
    manager.add(options(), **POLICY)
    return manager


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeJournal:
    return FakeJournal(monkeypatch, tmp_path)


def test_all_who_look_know_it(enabled: FakeManager, scope: Scope) -> None:
    (listed,) = read_whole_rows(enabled, scope, read_cells(enabled))
    (seen,) = Top(enabled, scope).look().entries
    (observed,) = read_snapshot(enabled, scope, is_whole=True)
    rows = (listed, seen.row, observed.row)
    assert [row.enabled for row in rows] == [True] * 3
    assert [row.restart_budget for row in rows] == [NEVER_YET] * 3


def test_an_older_one_of_that_name_is_not_enabled(enabled: FakeManager, scope: Scope) -> None:
    rows = [DataflowRow(uuid, "robot", UNIT, "Stopped") for uuid in ("new", "old")]
    assert [row.enabled for row in mark_enabled(enabled, scope, rows)] == [True, False]


def test_the_journal_is_asked_once_in_a_life(
    enabled: FakeManager, scope: Scope, journal: FakeJournal
) -> None:
    def asked() -> list[bool]:
        return ["--lines=3 " in one for one in journal.asked if UNIT_STARTING in one]

    _starts.cache_clear()
    facts = enabled.units[UNIT]
    facts["NRestarts"] = 2
    for state in ("running", "running", "reload", "running"):
        facts["SubState"] = state
        read_whole_rows(enabled, scope, read_cells(enabled))
    assert asked() == [True] * 2
    facts["ActiveEnterTimestampMonotonic"] = SECOND
    read_whole_rows(enabled, scope, read_cells(enabled))
    assert asked() == [True] * 3


def test_the_subject_of_a_report(enabled: FakeManager, scope: Scope, journal: FakeJournal) -> None:
    gone = DataflowRow(UUID, "gone", "dora-gone.service", "Finished", ended=1)
    journal.write(life_record("dataflow-finished", 1, "gone"))
    loaded = Subject(UUID, "robot", UNIT, "--system", is_loaded=True)
    assert subject_row(enabled, scope, loaded).restart_budget == NEVER_YET
    assert subject_row(enabled, scope, Subject(UUID, "gone", gone.unit, "--system")) == gone
    unknown = subject_row(enabled, scope, Subject("other", "x", "dora-x.service", "--system"))
    assert (unknown.uuid, unknown.name, unknown.ended) == ("other", "x", 0)
