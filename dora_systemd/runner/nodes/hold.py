"""Freezes nodes whose output dora's daemon reads, while the journal is behind.

A node with pipes blocks in write(2) instead. The kernel freezes a group by cgroup.freeze, see
cgroups(7).
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.log_backlog import Marks


class Hold:
    """Freezes the cgroup of one node while too many bytes of its output are unread."""

    def __init__(self, group: Path, marks: Marks) -> None:
        self._group = group
        self._marks = marks
        self._is_held = False
        self._since = 0.0
        self._is_paused = False
        self._is_over = False

    def look(self, backlog: int) -> None:
        """Freeze or thaw the group for this many unread bytes.

        If the kernel does not allow freezing, the node keeps running and lost lines are counted.
        """
        now = time.monotonic()
        is_held = self._marks.is_held(self._is_held, now - self._since, backlog)
        is_held = is_held and not (self._is_paused or self._is_over)
        if is_held != self._is_held:
            self._is_held = cgroup.freeze_group(self._group, is_held) and is_held
            self._since = now

    @property
    def is_held(self) -> bool:
        """Whether the group is frozen now."""
        return self._is_held

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Thaw the node meanwhile: it must get dora's message that another process replaces it."""
        self._is_paused = True
        self.look(0)
        try:
            yield
        finally:
            self._is_paused = False

    def end(self) -> None:
        """Thaw the node for good: it must get dora's request to stop."""
        self._is_over = True
        self.look(0)
