"""A restart that was refused is none, whoever counts."""

from pathlib import Path
from typing import Any

import pytest

from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.budget import read_restarts
from dora_systemd.verbs.facts.cells import read_cells
from dora_systemd.verbs.facts.list import read_rows, table_rows
from dora_systemd.verbs.list import read_whole_rows
from dora_systemd.verbs.stop import reset_cells
from dora_systemd.verbs.top import read_snapshot
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.manager import FakeManager, options

HELD = {"Job": [7, "/"], "JobType": "start"}


@pytest.mark.parametrize(
    ("facts", "count"),
    [
        ({"active": "failed", "NRestarts": 2, "ExecMainStatus": 75}, 1),
        ({"active": "failed", "NRestarts": 2, "ExecMainStatus": 75, **HELD}, 1),
        ({"active": "deactivating", "NRestarts": 2, "ExecMainStatus": 75}, 1),
        ({"active": "failed", "NRestarts": 2, "ExecMainStatus": 1}, 2),
        ({"active": "failed", "NRestarts": 0, "ExecMainStatus": 75}, 0),
        ({"active": "active", "NRestarts": 2, "ExecMainStatus": 0}, 2),
    ],
)
def test_a_refused_restart_counts_nowhere(
    scope: Scope,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    facts: dict[str, Any],
    count: int,
) -> None:
    """After `doractl reset` systemd counts from 0, and keeps the exit status."""
    FakeJournal(monkeypatch, tmp_path)
    manager = FakeManager()
    manager.add(options(), Restart="on-failure", **facts)
    cells = read_cells(manager)
    rows = [
        *(read_rows(manager, scope) + table_rows(manager, scope, cells)),
        *read_whole_rows(manager, scope, cells),
    ]
    (observed,) = read_snapshot(manager, scope)
    assert {row.restarts for row in rows} == {count}
    assert (observed.unit_restarts, observed.row.restarts) == (count, count)
    assert read_restarts(manager, cells[0]) == count
    assert f"was {count})" in reset_cells(manager, scope, cells)[0].text
