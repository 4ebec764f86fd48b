"""Wakes a task when the entries of directories change."""

import asyncio
import contextlib
from collections.abc import Iterable

from dora_systemd.adapters.host.inotify import Inotify


class Watch:
    """Directories that are watched by inotify(7). Close it.

    Where the kernel has no inotify instance left, wait() waits for its whole time.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._event = asyncio.Event()
        self._inotify: Inotify | None = None
        with contextlib.suppress(OSError):
            self._inotify = Inotify()
            self._loop.add_reader(self._inotify.fd, self._read)

    def _read(self) -> None:
        assert self._inotify is not None
        self._inotify.drain()
        self._event.set()

    def set_places(self, directories: Iterable[str]) -> None:
        """Watch these directories instead of those before; a thread may call this."""
        if self._inotify is not None:
            self._inotify.watch(directories)

    def clear(self) -> None:
        """Forget the changes so far."""
        self._event.clear()

    def wake(self) -> None:
        """Let the task look again."""
        self._event.set()

    async def wait(self, seconds: float) -> None:
        """Wait for a change, at most `seconds`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._event.wait()

    def close(self) -> None:
        """Stop watching."""
        if self._inotify is not None:
            self._loop.remove_reader(self._inotify.fd)
            self._inotify.close()
            self._inotify = None
