"""An event loop whose time passes at once."""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any


class ImpatientLoop(asyncio.SelectorEventLoop):
    """Its clock stands still, and jumps to the next timer when there is nothing else to do.

    So what runs on it must not wait for other processes; what it gives to a thread runs at once.
    """

    _ready: deque[asyncio.Handle]
    _scheduled: list[asyncio.TimerHandle]
    _ahead = 0.0

    def time(self) -> float:
        return self._ahead

    def jump(self, seconds: float) -> None:
        """Stand still for so long."""
        self._ahead += seconds

    def run_in_executor(  # type: ignore[override]
        self, _executor: Any, func: Callable[..., Any], *args: Any
    ) -> Any:
        """Run it in this thread: another one would have no time."""
        done: asyncio.Future[Any] = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:
            done.set_exception(error)
        return done

    def _run_once(self) -> None:
        times = [one.when() for one in self._scheduled if not one.cancelled()]
        if not self._ready and times:
            self._ahead += max(0.0, min(times) - self.time())
        super()._run_once()  # type: ignore[misc]


def live(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run `work` on such a loop, which fails at once if it waits for what cannot come."""

    with asyncio.Runner(loop_factory=ImpatientLoop) as runner:
        runner.run(within(3600, work()))


async def within(seconds: float, work: Awaitable[None]) -> None:
    """Wait for `work`. Raises TimeoutError if that takes longer."""
    async with asyncio.timeout(seconds):
        await work


async def settle() -> None:
    """Let all go on that can go on without time."""
    for _ in range(20):
        await asyncio.sleep(0)
