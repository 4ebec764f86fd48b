"""Watches the files of a dataflow while hot reload is on."""

import asyncio
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from dora_systemd.adapters.host.watch import Since, changed_files, watch_rules
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.runner.cell.begin import let_openssl_in

_LONGEST = 10.0
"""Seconds that whoever switches it on waits for a large tree."""


class Watcher:
    """Reports changed files.

    found: takes the files that have changed. refusing: reports an exception inside. has_moved:
    whether links lead to another dataflow.
    """

    def __init__(
        self,
        found: Callable[[frozenset[str]], None],
        refusing: Callable[[str], AbstractContextManager[None]],
        has_moved: Callable[[], bool] = bool,
    ) -> None:
        self._found = found
        self._has_moved = has_moved
        self._refusing = refusing
        self._task: asyncio.Task[None] | None = None
        self._has_seen = asyncio.Event()

    def watch(self, options: RunnerOptions | None, since: Since | None = None) -> None:
        """Watch the files of these options; None: watch nothing.

        since: report what was saved after that; by default, after this call.
        """
        since = since or Since(time.monotonic_ns())
        if self._task is not None:
            self._task.cancel()
        self._has_seen.clear()
        self._task = None if options is None else asyncio.create_task(self.collect(options, since))

    async def wait_seeing(self) -> None:
        """Return once a file that changes is noticed, or watching has failed."""
        if self._task is None:
            return
        seen = asyncio.create_task(self._has_seen.wait())
        first = asyncio.FIRST_COMPLETED
        await asyncio.wait({self._task, seen}, timeout=_LONGEST, return_when=first)
        seen.cancel()

    async def collect(self, options: RunnerOptions, since: Since | None = None) -> None:
        """Give the files that change to found(), without end."""
        with self._refusing("cannot watch files any more"):
            rules = await asyncio.to_thread(watch_rules, options)
            let_openssl_in()  # watchfiles imports anyio, which imports ssl
            seen, has_moved = self._has_seen.set, self._has_moved
            async for files in changed_files(rules, seen, has_moved, since=since):
                self._found(files)
