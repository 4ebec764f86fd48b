"""One budget for a stop: what TimeoutStopSec= allows, and what each part of the end may take."""

import asyncio
import threading
import time

import pytest

from dora_systemd.decisions.cell.options import RunnerOptions, parse_setting
from dora_systemd.decisions.life.stop_budget import (
    LEAVE_TIMEOUT,
    runner_timeout,
    stop_timeout,
    unit_timeout,
)
from dora_systemd.decisions.unit.properties import stop_properties
from dora_systemd.runner.cell.clock import (
    BACKLOG_SECONDS,
    STOP_SECONDS,
    Keepalive,
    StopClock,
    Ticks,
    watchdog_seconds,
)
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.loop import live

OPTIONS = RunnerOptions("r", "u", "/f.yml", "/", "/dora")


class Clock(StopClock):
    """It is as late as the test says."""

    def __init__(self, grace: int) -> None:
        self.at = 100.0
        super().__init__(OPTIONS._replace(grace=grace), lambda: self.at)


@pytest.mark.parametrize("grace", [0, SECOND, 10 * SECOND, 3600 * SECOND])
def test_the_parts_fit_the_whole(grace: int) -> None:
    options = OPTIONS._replace(grace=grace)
    whole = stop_properties(options)["TimeoutStopSec"].value
    # All that the states of the table may take; the rest is journald's.
    states = stop_timeout(grace) + LEAVE_TIMEOUT
    assert states + 3 * SECOND <= runner_timeout(options) < whole


def test_a_stop_with_times_of_nodes_has_the_limit_in_the_place_of_the_grace_duration() -> None:
    texts = ("recorder:stop=within=1min", "stop_limit=3min 20s")
    options = OPTIONS._replace(settings=tuple(map(parse_setting, texts)))
    assert stop_properties(options)["TimeoutStopSec"].value == 210 * SECOND
    assert runner_timeout(options) == 209 * SECOND


@pytest.mark.parametrize("grace", [INFINITY, INFINITY - 1, INFINITY // 3 * 2])
def test_the_longest_times_are_infinite(grace: int) -> None:
    options = OPTIONS._replace(grace=grace)
    assert unit_timeout(options) == INFINITY  # D-Bus has 64 bits
    assert runner_timeout(options) == INFINITY


@pytest.mark.parametrize("late", [0.0, 17.0, 22.0, 60.0])
def test_no_part_gets_more_than_what_is_left(late: float) -> None:
    clock = Clock(10 * SECOND)
    clock.begin("SIGTERM")
    clock.at += late
    end = 100.0 + runner_timeout(OPTIONS) / SECOND
    left = clock.for_journal()
    while left() > 0:
        assert clock.at + left() <= end
        clock.at += 0.5
    assert clock.at <= max(end, 100.0 + late) + 0.5
    assert clock.left(7.0) == max(min(7.0, end - clock.at), 0.0)


def test_nobody_waits() -> None:
    clock = Clock(10 * SECOND)
    left = clock.for_journal()
    assert (clock.left(7.0), left()) == (7.0, BACKLOG_SECONDS)
    clock.at += 10
    clock.begin("SIGTERM")
    assert left() == STOP_SECONDS, "it is in a hurry now"


def test_only_the_first_stop_counts() -> None:
    clock = Clock(0)
    clock.begin("SIGTERM")
    clock.at += 8
    clock.begin("SIGINT")
    assert (clock.by, clock.left(7.0)) == ("SIGTERM", 1.0)


def test_endless_grace() -> None:
    clock = Clock(INFINITY)
    clock.begin("SIGTERM")
    clock.at += 10**9
    assert clock.left(7.0) == 7.0


@pytest.mark.parametrize(
    ("environment", "watchdog", "seconds"),
    [
        ({"WATCHDOG_USEC": "30000000"}, 15.0, 15.0),
        ({"WATCHDOG_USEC": "5000000"}, 2.5, 2.5),
        ({"WATCHDOG_USEC": "600000000"}, 300.0, 15.0),
        ({}, None, 15.0),
    ],
)
def test_a_tick_is_half_of_the_watchdog(
    environment: dict[str, str], watchdog: float | None, seconds: float
) -> None:
    assert watchdog_seconds(environment) == watchdog
    assert Ticks(watchdog).seconds == seconds


def test_all_that_waits_for_a_tick_is_one_wakeup() -> None:
    async def work() -> None:
        loop, ticks = asyncio.get_running_loop(), Ticks(10.0)
        woken: list[float] = []

        async def wait(before: float) -> None:
            await asyncio.sleep(before)
            for _ in range(2):
                await ticks.wait()
                woken.append(loop.time())

        begun = loop.time()
        await asyncio.gather(*(wait(seconds) for seconds in (0.0, 3.0, 9.0)))
        assert [at - begun for at in woken] == [10.0] * 3 + [20.0] * 3

    live(work)


def test_a_task_that_gives_up_leaves_the_tick_to_the_others() -> None:
    async def work() -> None:
        loop, ticks = asyncio.get_running_loop(), Ticks(10.0)
        first = asyncio.create_task(ticks.wait())
        await asyncio.sleep(1)
        first.cancel()
        await ticks.wait()
        assert loop.time() == 10.0

    live(work)


def test_a_loop_that_runs_sends_by_itself() -> None:
    senders: list[threading.Thread] = []
    keepalive = Keepalive(60, lambda: senders.append(threading.current_thread()))

    async def work() -> None:
        task = asyncio.create_task(keepalive.beat(Ticks(0.01)))
        async with asyncio.timeout(60):
            while len(senders) < 3:
                await asyncio.sleep(0)
        task.cancel()

    asyncio.run(work())
    keepalive.end()
    assert set(senders) == {threading.current_thread()}


def test_a_loop_that_is_held_up_is_alive_for_a_while() -> None:
    sent = threading.Semaphore(0)
    keepalive = Keepalive(0.01, sent.release)

    async def work() -> None:
        task = asyncio.create_task(keepalive.beat(Ticks(0.01)))
        await asyncio.sleep(0)
        for _ in range(3):
            assert sent.acquire(timeout=20), "the loop stands still meanwhile"
        task.cancel()

    asyncio.run(work())
    assert sent.acquire(timeout=20), "also while the last lines are written"
    keepalive.end()


def test_a_loop_that_hangs_is_not_alive() -> None:
    sent: list[float] = []
    keepalive = Keepalive(0.01, lambda: sent.append(time.monotonic()), patience=0.3)

    async def work() -> float:
        task = asyncio.create_task(keepalive.beat(Ticks(0.01)))
        await asyncio.sleep(0)
        begun = time.monotonic()
        time.sleep(1)
        task.cancel()
        return begun

    begun = asyncio.run(work())
    keepalive.end()
    assert not [one for one in sent if begun + 0.35 < one < begun + 1]


def test_a_runner_that_exits_does_not_wait_for_it() -> None:
    keepalive = Keepalive(0.01, lambda: None)

    async def work() -> None:
        task = asyncio.create_task(keepalive.beat(Ticks(0.01)))
        await asyncio.sleep(0)
        own = [one for one in threading.enumerate() if one.name == "keepalive"]
        assert own
        assert all(one.daemon for one in own)
        task.cancel()

    asyncio.run(work())
    keepalive.end()
