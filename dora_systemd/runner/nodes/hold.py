"""Nodes that have to wait for the journal though dora reads their output: their group is frozen."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.log_backlog import Marks


class Hold:
    """Freezes `group`, of one node, while too much of what dora wrote of it is unread."""

    def __init__(self, group: Path, marks: Marks) -> None:
        self._group = group
        self._marks = marks
        self._is_held = False
        self._since = 0.0
        self._is_paused = False
        self._is_over = False

    def look(self, backlog: int) -> None:
        """So many bytes are unread now.

        Where the kernel does not let us freeze, the node runs on, and what is lost is told.
        """
        now = time.monotonic()
        is_held = self._marks.is_held(self._is_held, now - self._since, backlog)
        is_held = is_held and not (self._is_paused or self._is_over)
        if is_held != self._is_held:
            self._is_held = cgroup.freeze_group(self._group, is_held) and is_held
            self._since = now

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Let the node go meanwhile: it is to hear that another one takes its place."""
        self._is_paused = True
        self.look(0)
        try:
            yield
        finally:
            self._is_paused = False

    def end(self) -> None:
        """Let the node go, for good: it is to hear that it shall stop."""
        self._is_over = True
        self.look(0)
