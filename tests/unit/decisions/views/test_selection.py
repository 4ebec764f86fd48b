"""Rows by the options of `dora list`."""

import pytest

from dora_systemd.decisions.views.dataflows import FAILED, FINISHED, STOPPED, UP_WORDS
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.selection import (
    SORTS,
    STATUSES,
    is_of_the_past,
    matching_rows,
    sorted_rows,
)

ROWS = [
    DataflowRow("1", "robot", "u", "Running", cpu_percent=5.0, memory=3, restarts=0, uptime=9),
    DataflowRow("2", "Robot-arm", "u", "Degraded", cpu_percent=50.0, memory=1, uptime=1),
    DataflowRow("3", "vision", "u", "Failed", restarts=7),
    DataflowRow("4", "audio", "u", "Stopped"),
    DataflowRow("5", "robot-old", "u", "Finished"),
]


def selected(status: str | None = None, part: str | None = None, sort: str | None = None) -> str:
    return "".join(row.uuid for row in sorted_rows(matching_rows(ROWS, status, part), sort))


@pytest.mark.parametrize(
    ("status", "uuids"),
    [
        *((None, "12345"), ("running", "12"), ("finished", "45"), ("failed", "3")),
        *(("degraded", "2"), ("stopped", "4"), ("starting", "")),
    ],
)
def test_status(status: str | None, uuids: str) -> None:
    assert selected(status) == uuids


def test_doras_words_are_all_there_are() -> None:
    three = [STATUSES[word] for word in ("running", "finished", "failed")]
    assert frozenset().union(*three) == {*UP_WORDS, FINISHED, STOPPED, FAILED}
    assert sum(map(len, three)) == len(UP_WORDS) + 3
    assert [word for word in STATUSES if is_of_the_past(word)] == ["finished", "failed", "stopped"]
    assert not is_of_the_past(None)


@pytest.mark.parametrize(
    ("pattern", "uuids"),
    [("robot", "125"), ("OBO", "125"), ("r*arm", "2"), ("?ision", "3"), ("", "12345"), ("x", "")],
)
def test_names(pattern: str, uuids: str) -> None:
    assert selected(part=pattern) == uuids


def test_order() -> None:
    assert selected(sort="cpu") == "21345"
    assert selected(sort="memory") == "12345"
    assert selected(sort="restarts") == "31245"
    assert selected(sort="uptime") == "12345"
    assert selected(sort="name") == "24153"
    assert {*SORTS} == {"cpu", "memory", "restarts", "uptime", "name"}
    assert selected("running", "robot", "cpu") == "21"
