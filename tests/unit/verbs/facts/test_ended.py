"""Dataflows that only the journal knows."""

import pytest

from dora_systemd.adapters.journal.reader import LastEvent
from dora_systemd.verbs.facts.ended import ended_row

UUID = "550e8400-e29b-41d4-a716-446655440000"


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
