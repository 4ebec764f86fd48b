"""The keepalive of the runner's own watchdog, with real threads."""

import asyncio
import threading
import time

from dora_systemd.runner.cell.keepalive import Keepalive


def test_a_loop_that_is_held_up_is_alive_for_a_while() -> None:
    sent = threading.Semaphore(0)
    keepalive = Keepalive(0.01, sent.release)

    async def work() -> None:
        task = asyncio.create_task(keepalive.beat())
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
        task = asyncio.create_task(keepalive.beat())
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
        task = asyncio.create_task(keepalive.beat())
        await asyncio.sleep(0)
        own = [one for one in threading.enumerate() if one.name == "keepalive"]
        assert own
        assert all(one.daemon for one in own)
        task.cancel()

    asyncio.run(work())
    keepalive.end()
