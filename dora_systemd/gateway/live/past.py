"""What the page shows of the past of a dataflow: its timeline, from the journal."""

import time
from collections.abc import Sequence
from itertools import islice, takewhile
from typing import Any

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.journal.reader import JournalReader, check_readable
from dora_systemd.decisions.gateway.page_messages import shown_values
from dora_systemd.decisions.gateway.timeline import EVENTS, MOST_MARKS, OUTSIDE, timeline_values
from dora_systemd.decisions.logs.journal_events import REQUESTS
from dora_systemd.decisions.logs.query import timeline_matches
from dora_systemd.decisions.why.lives import Happening, parse_happening
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.cells import read_cells
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
)
"""Those of the records that timeline_values() uses."""


def read_timeline(scope: Scope, uuid: str) -> dict[str, Any]:
    """Lives, restarts, failures, releases and bundles of a dataflow. Raises DoraSystemdError."""
    check_readable(scope)
    name, is_up = _subject(scope, uuid)
    now_us = time.time_ns() // 1000
    happenings, is_whole = _happenings(scope, name, uuid, now_us - SPAN)
    found = timeline_values(happenings, uuid, is_up, now_boot())
    found["is_cut"] |= not is_whole
    values: dict[str, Any] = shown_values(found, MOST_MARKS)
    return {**values, "now_us": now_us, "since_us": now_us - SPAN}


def _subject(scope: Scope, uuid: str) -> tuple[str, bool]:
    """The name of a dataflow, and whether it is up."""
    wanted, cells = Selector(uuid), read_cells(Bus(scope, for_reading=True))
    ended = None if wanted.meant(cells) else wanted.ended(scope)
    if ended is not None:
        return ended.name, False
    cell = wanted.loaded(cells)
    return cell.name, cell.is_up


def _happenings(
    scope: Scope, name: str, uuid: str, since_us: int
) -> tuple[Sequence[Happening], bool]:
    """What the journal has since then, oldest first, and whether that is all."""
    matches = timeline_matches(scope, name, uuid, EVENTS, (*OUTSIDE, *REQUESTS))
    records = islice(JournalReader().newest(matches, None, fields=_FIELDS), _MOST_RECORDS)
    new = list(takewhile(lambda one: int(one["__REALTIME_TIMESTAMP"]) >= since_us, records))
    found = [one for one in map(parse_happening, reversed(new)) if one is not None]
    return found, len(new) < _MOST_RECORDS
