"""Turns every exception in the runner into an event that ends the cell, so none gets lost."""

import asyncio
import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Coroutine
from typing import Any

from dora_systemd.decisions.life import events as life
from dora_systemd.errors import DoraSystemdError

Push = Callable[[life.Event], None]


def failed(what: str, error: Exception) -> life.Failed:
    """Return the event for an exception. Prints the traceback to the journal, at debug level."""
    at_us = time.time_ns() // 1000
    if isinstance(error, DoraSystemdError):
        return life.Failed(at_us, what, error.message)
    lines = "".join(traceback.format_exception(error)).splitlines()
    say("\n".join(f"<7>{line}" for line in lines))
    return life.Failed(at_us, what, words(error))


def say(text: str) -> None:
    """Print to the journal, if journald still reads standard error: it may have restarted."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def words(error: Exception) -> str:
    """Format the exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())


class Tasks:
    """Tasks of the runner. An exception in one is given to raised(), so it does not get lost."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()

    def spawn(self, what: str, work: Coroutine[Any, Any, None]) -> None:
        """Run `work` until it ends or cancel(). what: what it does, as in "could not ..."."""
        task = asyncio.create_task(self._guard(what, work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _guard(self, what: str, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except Exception as error:
            await self.raised(what, error)

    async def raised(self, what: str, error: Exception) -> None:
        raise NotImplementedError

    def cancel(self) -> None:
        for task in self._tasks:
            task.cancel()


class Beside(Tasks):
    """Tasks that outlast the runs of the dataflow. An exception in one ends the current run.

    push: takes the events of that run; between two runs the next run gets the event.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._push: Push | None = None
        self._failure: life.Failed | None = None
        loop.set_exception_handler(self._callback_raised)

    def attach(self, push: Push) -> None:
        """Send events to the `push` of the run that begins."""
        self._push = push
        if self._failure is not None:
            push(self._failure)

    async def raised(self, what: str, error: Exception) -> None:
        """End the current run, and the later ones: they would lack this task too."""
        self._failure = failed(what, error)
        self._tell(self._failure)

    def _tell(self, failure: life.Failed) -> None:
        if self._push is not None:
            self._push(failure)

    def _callback_raised(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an exception of a reader, a timer or a signal handler; asyncio only logs them."""
        error = context.get("exception")
        callback = getattr(context.get("handle"), "_callback", None)
        if callback is None or not isinstance(error, Exception):
            loop.default_exception_handler(context)
            return
        name = getattr(getattr(callback, "func", callback), "__qualname__", "a callback")
        self._tell(failed(f"finish {name}", error))
