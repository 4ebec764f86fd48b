"""Notices when dora writes to its log files of nodes, which are not polled while they rest."""

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path

from dora_systemd.adapters.host.inotify import MODIFY, Inotify


class LogChanges:
    """Watches the log files of one run by inotify(7). Close it.

    directory: of the files, which dora creates. wake: called after the first change that follows a
    watch(); all later ones cost nothing until the next watch().
    """

    def __init__(self, directory: Path, wake: Callable[[], None]) -> None:
        self._directory, self._wake = str(directory), wake
        self._loop = asyncio.get_running_loop()
        self._inotify: Inotify | None = None

    def watch(self) -> bool:
        """Watch for the next change; False if the kernel has no inotify instance left."""
        with contextlib.suppress(OSError):
            self._inotify = self._inotify or Inotify(MODIFY)
            self._inotify.drain()
            if self._inotify.watch([self._directory]):
                self._loop.add_reader(self._inotify.fd, self._changed, self._inotify)
                return True
        return False

    def _changed(self, inotify: Inotify) -> None:
        self._loop.remove_reader(inotify.fd)
        self._wake()

    def close(self) -> None:
        if self._inotify is not None:
            self._loop.remove_reader(self._inotify.fd)
            self._inotify.close()
            self._inotify = None
