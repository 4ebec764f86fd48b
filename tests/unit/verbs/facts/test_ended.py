"""Dataflows that only the journal knows."""

import pytest

from dora_systemd.adapters.journal.reader import LastEvent
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.facts.ended import ended_row, not_recorded
from dora_systemd.verbs.facts.last_words import _line

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


def test_lines_of_nodes() -> None:
    assert _line({"DORA_NODE": "camera", "MESSAGE": "hello"}) == "camera: hello"
    assert _line({"DORA_NODE": "camera", "MESSAGE": [1, 2]}) == "camera: (binary)"
