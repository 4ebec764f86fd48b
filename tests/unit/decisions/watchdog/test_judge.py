"""When a node has missed its watchdog; a day passes at once."""

import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.watchdog.judge import (
    TRIGGERED,
    Act,
    Clock,
    Phase,
    Watch,
    by_watchdog,
    limit_in,
    missed,
    period_of,
)
from dora_systemd.values import INFINITY, SECOND

LIMIT, GRACE, HOUR = 4 * SECOND, 10 * SECOND, 3600 * SECOND
PERIOD = period_of([LIMIT])


class Told(NamedTuple):
    """What a look sees. at: CLOCK_MONOTONIC. signed: whether a sign came since the last look."""

    at: int
    pid: int = 1
    signed: bool = False


def acts(looks: Iterable[Told], phase: Phase = Phase.RUNNING) -> Iterator[tuple[int, Act]]:
    """What is done, and when."""
    clock, watch, signed = Clock(PERIOD, 0), Watch(), None
    for look in looks:
        clock = clock.at(look.at)
        if look.pid != watch.pid:
            signed = None
        signed = clock.now if look.signed else signed
        watch = watch.of(phase if look.pid else Phase.AWAY, look.pid, signed, clock.now)
        act = watch.act(LIMIT, GRACE, clock.now)
        if act is Act.ABORT:
            watch = watch._replace(aborted=clock.now)
        if act is Act.KILL:
            watch = watch._replace(is_killed=True)
        if act is not Act.NOTHING:
            yield look.at, act


def silent_each_hour() -> Iterator[Told]:
    """A day of a node that feeds its watchdog, and falls silent when an hour is over.

    It is back two seconds after it was ended. The machine sleeps for a while in each hour.
    """
    at, pid, skipped = 0, 1, 0
    for hour in range(24):
        quiet = (hour + 1) * HOUR
        while at < quiet + LIMIT + PERIOD:
            at += PERIOD
            asleep = 600 * SECOND if at % HOUR == HOUR // 2 else 0
            skipped += asleep
            yield Told(at + skipped, pid, at < quiet and at % (LIMIT // 2) == 0)
        pid += 1
        yield from (Told(at + skipped + n * PERIOD, 0) for n in range(1, 5))
        at += 4 * PERIOD


def test_a_day_of_silence_each_hour() -> None:
    found = list(acts(silent_each_hour()))
    assert [act for _, act in found] == [Act.ABORT] * 24, "none missed, none invented"
    gaps = [b - a for (a, _), (b, _) in itertools.pairwise(found)]
    assert all(HOUR < gap < HOUR + 700 * SECOND for gap in gaps)


@given(st.lists(st.integers(0, LIMIT - PERIOD - 1), max_size=50))
def test_a_slow_node_is_never_touched(pauses: list[int]) -> None:
    signs = list(itertools.accumulate(pauses))
    last = max(signs, default=0)
    looks = range(PERIOD, last + PERIOD, PERIOD)
    told = (Told(at, 1, any(at - PERIOD < one <= at for one in signs)) for at in looks)
    assert list(acts(told)) == []


@given(st.integers(0, 20), st.integers(2 * PERIOD + 1, 48 * HOUR))
def test_a_stopped_cell_is_no_silence(before: int, gap: int) -> None:
    """A node that sends twice in its time goes on where it was stopped, at any moment."""
    awake = [Told(n * PERIOD, 1, n % 4 == 0) for n in range(before + 1)]
    again = before * PERIOD + gap
    after = [Told(again + n * PERIOD, 1, (before + n) % 4 == 0) for n in range(8)]
    assert list(acts([*awake, *after])) == []


def test_a_node_that_does_not_end_is_killed_once() -> None:
    looks = [Told(n * PERIOD) for n in range(100)]
    found = list(acts(looks))
    assert [act for _, act in found] == [Act.ABORT, Act.KILL]
    assert found[1][0] - found[0][0] == GRACE
    assert list(acts([Told(n * PERIOD, n) for n in range(1, 99)])) == [], "each process begins anew"


def test_limits() -> None:
    assert limit_in(Phase.RUNNING, LIMIT, 60 * SECOND) == LIMIT
    assert limit_in(Phase.STARTING, LIMIT, 60 * SECOND) == 60 * SECOND
    assert limit_in(Phase.STARTING, LIMIT, INFINITY) == 90 * SECOND
    assert limit_in(Phase.STARTING, 2 * HOUR, INFINITY) == 2 * HOUR
    assert limit_in(Phase.STARTING, INFINITY, SECOND) == INFINITY, "a socket without a watchdog"
    assert period_of([]) == 5 * SECOND
    assert period_of([LIMIT, SECOND, INFINITY]) == SECOND // 8


def test_an_excuse() -> None:
    watch = Watch().of(Phase.RUNNING, 1, None, 0).excused(LIMIT - 1)
    assert watch.act(LIMIT, GRACE, LIMIT) is Act.NOTHING
    assert watch.act(LIMIT, GRACE, 2 * LIMIT) is Act.ABORT


@pytest.mark.parametrize("phase", [Phase.RUNNING, Phase.STARTING])
def test_words(phase: Phase) -> None:
    assert by_watchdog(missed(phase, LIMIT))
    assert by_watchdog(TRIGGERED)
    assert not by_watchdog("unresponsive for 5322ms")
