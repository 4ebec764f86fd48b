"""When memory or CPU time that gets short is reported, and that nothing floods the journal."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.resources.pressure import (
    BAD_LOOKS,
    CPU,
    GOOD_LOOKS,
    IDLE,
    MEMORY,
    QUIET,
    Alarms,
    Load,
    Report,
    is_quiet,
    look,
)
from dora_systemd.values import SECOND

STEP = 5 * SECOND
GIB = 1 << 30
FULL = Load(held=950 << 20, limit=GIB)
STALLED = Load(held=1 << 20, limit=GIB, stalled=40.0)
WELL = Load(held=1 << 20, limit=GIB)
BETWEEN = Load(held=850 << 20, limit=GIB)
WAITING = Load(throttled=99.0)
FLOWING = Load(throttled=1.0)


def live(*loads: Load, key: str = "a") -> list[tuple[int, Report]]:
    """The reports about one group that is looked at every 5 s, each with the number of its look."""
    alarms: Alarms = {}
    found = []
    for number, load in enumerate(loads):
        alarms, reports = look(alarms, {key: load}, STEP * (number + 1))
        found += [(number, report) for report in reports]
    return found


def test_memory_is_reported_at_once_and_once() -> None:
    ((number, report),) = live(WELL, FULL, FULL, FULL, BETWEEN, FULL)
    assert (number, *report[:2]) == (1, MEMORY, "a")
    assert report[2]["reason"] == "node a holds 950M of 1G, waiting 0% of the time"
    ((_, report),) = live(STALLED)
    assert report[2]["stalled"] == "40"


@pytest.mark.parametrize(
    ("whole", "node", "expected"),
    [
        (Load(cpu=IDLE / 2), Load(held=GIB), True),
        (Load(cpu=IDLE), Load(), False),
        (Load(cpu=IDLE / 2), WELL, False),
        (Load(cpu=IDLE / 2), FLOWING, False),
        (WELL, Load(), False),
    ],
)
def test_nothing_happens_where_no_limit_can_be_reached(
    whole: Load, node: Load, expected: bool
) -> None:
    assert is_quiet({"": whole, "a": node}) is expected


def test_the_dataflow_has_no_node() -> None:
    ((_, report),) = live(FULL, key="")
    assert report[1] == ""
    assert report[2]["reason"].startswith("its nodes together hold 950M")


def test_cpu_is_reported_when_it_lasts() -> None:
    assert live(*[WAITING] * (BAD_LOOKS[CPU] - 1), FLOWING, WAITING) == []
    ((number, report),) = live(*[WAITING] * 20)
    assert (number, report[0]) == (BAD_LOOKS[CPU] - 1, CPU)
    assert report[2]["reason"] == "node a had to wait for the limit 99% of the time"


def test_without_a_limit_nothing_is_short() -> None:
    assert live(*[Load(held=GIB, stalled=99.0)] * 20) == []


def test_again_after_it_was_well_for_a_while() -> None:
    looks = QUIET // STEP
    well = [WELL] * looks
    assert [number for number, _ in live(FULL, *well, FULL)] == [0, looks + 1]
    assert len(live(FULL, *[WELL] * GOOD_LOOKS, FULL)) == 1, "too soon"
    assert len(live(FULL, *[BETWEEN] * looks, FULL)) == 1, "it was never well"
    late = live(FULL, *[WELL] * GOOD_LOOKS, *[FULL] * looks)
    assert len(late) == 2, "it is bad still when it may be said again"


@given(st.lists(st.sampled_from([FULL, STALLED, WELL, BETWEEN, WAITING, FLOWING]), max_size=400))
def test_reports_of_one_kind_are_far_apart(loads: list[Load]) -> None:
    for event in (MEMORY, CPU):
        numbers = [number for number, report in live(*loads) if report[0] == event]
        gaps = [b - a for a, b in pairwise(numbers)]
        assert all(gap * STEP >= QUIET for gap in gaps)
