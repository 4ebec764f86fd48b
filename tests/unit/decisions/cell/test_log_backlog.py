"""When a node whose output dora reads has to wait for the journal."""

from typing import Any

import pytest

from dora_systemd.decisions.cell.log_backlog import BREATH, MARKS, Marks, marks_of, with_bounds

TEN = Marks(hold=10, free=7, longest=2.0)


@pytest.mark.parametrize(
    ("was_held", "seconds", "backlog", "is_held"),
    [
        (False, 1, 9, False),
        (False, 1, 10, True),
        (False, BREATH / 2, 10, False),  # it has only just gone on
        (True, 1, 9, True),
        (True, 1, 7, True),
        (True, 1, 6, False),
        (True, 2, 100, False),  # dora would take it for hung
    ],
)
def test_is_held(was_held: bool, seconds: float, backlog: int, is_held: bool) -> None:
    assert TEN.is_held(was_held, seconds, backlog) is is_held


@pytest.mark.parametrize(
    ("keys", "marks"),
    [
        ({}, MARKS),
        ({"max_log_size": None, "max_rotated_files": None}, MARKS),
        ({"max_log_size": "1GB"}, MARKS),
        ({"max_log_size": "what dora may know"}, MARKS),
        ({"max_log_size": "9" * 5000}, MARKS),
        ({"max_log_size": "0"}, Marks(1, 1)),
        ({"max_log_size": "4B"}, Marks(1, 1)),
        ({"max_log_size": "400KB"}, Marks(100_000, 50_000)),
        ({"max_log_size": "400 kb", "max_rotated_files": 3}, Marks(300_000, 150_000)),
        ({"max_log_size": 4000, "max_rotated_files": 0}, Marks(1000, 500)),
        ({"health_check_timeout": 2}, Marks(MARKS.hold, MARKS.free, 0.5)),
    ],
)
def test_marks(keys: dict[str, Any], marks: Marks) -> None:
    assert marks_of({"id": "n", **keys}) == marks


@pytest.mark.parametrize("size", ["0", "4", "1KB", "16MB"])
def test_a_node_goes_on_when_all_is_read(size: str) -> None:
    marks = marks_of({"id": "n", "max_log_size": size})
    assert marks.is_held(False, 1, marks.hold)
    assert not marks.is_held(True, 1, 0)


def test_bounds_of_dora_s_files() -> None:
    assert with_bounds({"id": "n", "max_log_size": "1MB", "max_rotated_files": None}) == {
        "id": "n",
        "max_log_size": "1MB",
        "max_rotated_files": 1,
    }


def test_there_is_room_for_what_dora_writes_before_it_waits() -> None:
    assert MARKS.hold * 4 <= 16_000_000
    assert MARKS.free < MARKS.hold
