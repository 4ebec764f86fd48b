"""What the page shows of the past of a dataflow: its timeline, from the journal."""

import time
from collections.abc import Mapping, Sequence
from itertools import islice, takewhile
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.decisions.gateway.page_messages import shown_values
from dora_systemd.decisions.gateway.timeline import (
    EVENTS,
    MOST_MARKS,
    OUTSIDE,
    Now,
    Use,
    parse_use,
    timeline_values,
)
from dora_systemd.decisions.logs.journal_events import REQUESTS
from dora_systemd.decisions.logs.query import timeline_matches
from dora_systemd.decisions.why.lives import parse_happening
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.facts.selector import Selector

SPAN = 7 * 24 * 3600 * SECOND
"""µs before now that the timeline has."""
_MOST_RECORDS = 5000
_FIELDS = (
    *("MESSAGE", "MESSAGE_ID", "CODE_FUNC", "UNIT_RESULT", "EXIT_CODE", "EXIT_STATUS"),
    *("_SYSTEMD_INVOCATION_ID", "INVOCATION_ID", "USER_INVOCATION_ID", "_BOOT_ID"),
    *(f"DORA_{one}" for one in ("EVENT", "NODE", "DATAFLOW", "EXIT", "REASON", "CAUSE", "NODES")),
    *(f"DORA_{one}" for one in ("BY", "ASKED", "MACHINE", "HELD_PEAK", "CPU_PEAK")),
    *("CPU_USAGE_NSEC", "MEMORY_PEAK"),
)
"""Those of the records that timeline_values() and parse_use() use."""


def read_timeline(scope: Scope, uuid: str) -> dict[str, Any]:
    """Lives, restarts, failures, releases and bundles of a dataflow. Raises DoraSystemdError."""
    check_readable(scope)
    manager = Bus(scope, for_reading=True)
    name, cell = find_subject(manager, scope, uuid)
    now = Now(now_boot(), time.time_ns() // 1000, _use_of(manager, cell))
    records, is_whole = _records(scope, name, uuid, now.at_us - SPAN)
    happenings = [one for one in map(parse_happening, records) if one is not None]
    used = dict(one for one in map(parse_use, records) if one is not None)
    found = timeline_values(happenings, uuid, now, used)
    found["is_cut"] |= not is_whole
    values: dict[str, Any] = shown_values(found, MOST_MARKS)
    return {**values, "now_us": now.at_us, "since_us": now.at_us - SPAN}


def find_subject(manager: Manager, scope: Scope, uuid: str) -> tuple[str, Cell | None]:
    """The name of a dataflow, and its cell, None if systemd has unloaded it.

    Raises DoraSystemdError (NOT_FOUND).
    """
    wanted, cells = Selector(uuid), read_cells(manager)
    ended = None if wanted.meant(cells) else wanted.ended(scope)
    if ended is not None:
        return ended.name, None
    cell = wanted.loaded(cells)
    return cell.name, cell


def _use_of(manager: Manager, cell: Cell | None) -> Use | None:
    """What a dataflow has used since its start, None if it is not up."""
    if cell is None or not cell.is_up:
        return None
    group = manager.read(cell.unit, ["ControlGroup"])["ControlGroup"]
    if not group:
        return Use()
    use = cgroup.read_usage(cgroup.group_path(group))
    return Use(use.cpu_us, use.memory_peak)


def _records(
    scope: Scope, name: str, uuid: str, since_us: int
) -> tuple[Sequence[Mapping[str, Any]], bool]:
    """The records in the journal since then, oldest first, and whether that is all."""
    matches = timeline_matches(scope, name, uuid, EVENTS, (*OUTSIDE, *REQUESTS))
    records = islice(JournalReader().newest(matches, None, fields=_FIELDS), _MOST_RECORDS)
    new = list(takewhile(lambda one: int(one["__REALTIME_TIMESTAMP"]) >= since_us, records))
    return new[::-1], len(new) < _MOST_RECORDS
