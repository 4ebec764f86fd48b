"""Dataflows that systemd has not begun to start: what their start waits for, and since when.

systemd knows which jobs a job waits for, but reports no time when a job was queued. So that time is
the latest of what comes before: the boot, the end of the last run, and the file of a transient
unit, which systemd writes when it queues the start of the unit.
"""

import time
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import written_us
from dora_systemd.decisions.needs.units import format_awaited
from dora_systemd.decisions.needs.waiting import START, format_wait
from dora_systemd.decisions.views.dataflows import STARTING, WAITING
from dora_systemd.verbs.facts.cells import Cell

_FACTS = ("StateChangeTimestampMonotonic", "Transient", "FragmentPath")


class Held(NamedTuple):
    """What a start waits for, "" if it begins right now."""

    needs: str
    since_us: int  # CLOCK_REALTIME µs

    @property
    def word(self) -> str:
        return WAITING if self.needs else STARTING

    @property
    def text(self) -> str:
        """Format "the start waits for network since 2026-11-22 14:02:11 UTC", or ""."""
        return format_wait(START, self.needs, self.since_us) if self.needs else ""


def read_held(manager: Manager, cell: Cell) -> Held:
    """Read what systemd waits for before it starts the dataflow. Raises DoraSystemdError."""
    needs = format_awaited(manager.awaited(cell.unit))
    facts = manager.read(cell.unit, _FACTS)
    asked = written_us(Path(facts["FragmentPath"])) if facts["Transient"] else 0
    booted = _now_us(time.CLOCK_REALTIME) - _now_us(time.CLOCK_MONOTONIC)
    ended = int(facts["StateChangeTimestampMonotonic"] or 0)
    return Held(needs, max(asked, booted + max(ended, manager.began_us())))


def _now_us(clock: int) -> int:
    return time.clock_gettime_ns(clock) // 1000
