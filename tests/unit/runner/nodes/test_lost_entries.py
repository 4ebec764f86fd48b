"""Sent and stored, compared."""

import asyncio

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.nodes.lost_entries import CHECK_TICKS, LossWatch


class Case:
    def __init__(self) -> None:
        self.sent = 0
        self.stored = 0
        self.counted = 0
        self.now = 0
        self.reported: list[int] = []
        self.windows: list[tuple[int, int]] = []
        self.failure: Exception | None = None
        self.watch = LossWatch(
            lambda: self.sent, self.count, self.reported.append, lambda: self.now
        )

    def count(self, since: int, until: int) -> int:
        self.windows.append((since, until))
        if self.failure is not None:
            raise self.failure
        new, self.counted = self.stored - self.counted, self.stored
        return new

    def look(self, now: int, sent: int, stored: int) -> None:
        self.now, self.sent, self.stored = now, sent, stored
        asyncio.run(self.watch.check())

    def finish(self, now: int, sent: int, stored: int) -> None:
        self.now, self.sent, self.stored = now, sent, stored
        asyncio.run(self.watch.finish())


def test_it_checks_at_every_second_tick() -> None:
    case, ticks = Case(), 0

    async def wait() -> None:
        nonlocal ticks
        ticks, case.sent = ticks + 1, case.sent + 5000
        if ticks > 2 * CHECK_TICKS:
            raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(case.watch.run(wait))
    assert len(case.windows) == 2


def test_a_quiet_dataflow_is_not_looked_at() -> None:
    case = Case()
    case.look(30, 900, 900)
    case.finish(60, 950, 940)
    assert not case.windows


def test_what_is_on_its_way_is_no_loss() -> None:
    case = Case()
    case.look(30, 5000, 4600)
    case.look(60, 9000, 9000)
    case.finish(90, 9000, 9000)
    assert not case.reported


def test_loss_is_reported_once_and_in_full() -> None:
    case = Case()
    case.look(30, 50_000, 32_000)
    case.look(60, 52_000, 34_000)
    case.finish(90, 52_010, 34_005)
    assert case.reported == [18_000, 5]


def test_windows_do_not_overlap() -> None:
    case = Case()
    for now in (30, 60, 90):
        case.look(now, now * 1000, now * 1000)
    assert case.windows == [(0, 29), (30, 59), (60, 89)]


@pytest.mark.parametrize("failure", [DoraSystemdError("no journal"), RuntimeError("no thread")])
def test_a_journal_that_cannot_be_read_ends_nothing(failure: Exception) -> None:
    case = Case()
    case.failure = failure
    case.look(30, 50_000, 32_000)
    case.finish(40, 50_000, 32_000)
    case.failure = None
    case.look(60, 50_000, 32_000)
    assert case.windows == [(0, 29), (0, 39), (0, 59)]
    assert case.reported == [18_000]
