"""The timeline of a dataflow on the status page: its lives, and marks of what happened. Pure.

All of it is read back from journal records, which nodes can write: it is bounded.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from dora_systemd.decisions.logs.journal_events import (
    BUILD_FAILED,
    BUNDLE_REFUSED,
    BUNDLE_WRITTEN,
    END_EVENTS,
    GIVEN_UP,
    ROLLED_BACK,
    START_ASKED,
)
from dora_systemd.decisions.logs.query import UNIT_RESOURCES
from dora_systemd.decisions.why.lives import Happening, Life, find_lives, parse_number, plain_text
from dora_systemd.decisions.why.postmortem import examine
from dora_systemd.decisions.why.verdict import Facts

MOST_MARKS, MOST_LIVES = 1000, 200
"""The newest ones are kept."""
_MOST_TEXT = 300
_MOST_DIGITS = 19

MARKS = {
    **dict.fromkeys(("node-restarted", "unit-restart"), "restart"),
    **dict.fromkeys((START_ASKED, "stop-asked", "node-asked", "reloaded"), "request"),
    **dict.fromkeys(("node-reloaded", "reload-failed"), "request"),
    **dict.fromkeys(("node-crashed", "node-ended", "node-hung", "node-watchdog"), "failure"),
    **dict.fromkeys((GIVEN_UP, "coordinator-lost", "daemon-lost", "machine-lost"), "failure"),
    **dict.fromkeys(("dataflow-failed", "unit-failed", "start-limit"), "failure"),
    **dict.fromkeys(("node-oom", "dataflow-oom", "memory-pressure"), "memory"),
    **dict.fromkeys(("node-silent", "node-speaks-again"), "silence"),
    "release-committed": "deploy",
    **dict.fromkeys((ROLLED_BACK, BUILD_FAILED), "rollback"),
    **dict.fromkeys((BUNDLE_WRITTEN, BUNDLE_REFUSED), "bundle"),
}
"""The kind of the mark of each event."""
EVENTS = (
    *("dataflow-starting", "dataflow-started", "dataflow-stopping", *END_EVENTS),
    *(one for one in MARKS if not one.startswith(("unit-", "start-limit"))),
)
"""Those of our events that the timeline shows."""
OUTSIDE = (START_ASKED, BUNDLE_WRITTEN, BUNDLE_REFUSED)
"""What doractl writes outside of any life of the dataflow."""
_UNIT_ENDS = ("unit-succeeded", "unit-failed")


class Use(NamedTuple):
    """What a life has used, None where that is not known."""

    cpu_us: int | None = None  # CPU time
    memory: int | None = None  # bytes, the most


class Now(NamedTuple):
    """The present."""

    boot: str
    at_us: int = 0  # CLOCK_REALTIME
    use: Use | None = None  # of the last life, None if that has ended


def parse_use(record: Mapping[str, Any]) -> tuple[str, Use] | None:
    """The invocation of a unit, and what systemd records of its use; None for other records."""
    # A node can write any field, but its record is about an event of ours.
    if record.get("MESSAGE_ID") != UNIT_RESOURCES or "DORA_EVENT" in record:
        return None
    ids = (plain_text(record.get(key)) for key in ("INVOCATION_ID", "USER_INVOCATION_ID"))
    cpu = _number(plain_text(record.get("CPU_USAGE_NSEC")))
    memory = _number(plain_text(record.get("MEMORY_PEAK")))
    return next(filter(None, ids), ""), Use(None if cpu is None else cpu // 1000, memory)


def timeline_values(
    happenings: Sequence[Happening], uuid: str, now: Now, used: Mapping[str, Use]
) -> dict[str, Any]:
    """The lives and the marks, oldest first, for JSON; texts are not yet made printable.

    happenings: oldest first. used: what lives have used, by invocation.
    """
    lives = own_lives(happenings, uuid)[-MOST_LIVES:]
    shown = [_life(life, now, used.get(life.invocation, Use())) for life in lives]
    if lives and now.use is not None:
        shown[-1] = _open_life(lives[-1], now, now.use)
    begin = min((one["began_us"] for one in shown), default=0)
    marks = [_mark(one) for one in happenings if one.name in MARKS and _is_own(one, uuid, begin)]
    return {"lives": shown, "marks": marks[-MOST_MARKS:], "is_cut": len(marks) > MOST_MARKS}


def _is_own(one: Happening, uuid: str, begin: int) -> bool:
    """Whether it is about the dataflow `uuid`: systemd's records of the unit do not name it."""
    known = one.detail("dataflow")
    return known == uuid if known else one.at_us >= begin


def own_lives(happenings: Iterable[Happening], uuid: str) -> list[Life]:
    """The lives of the dataflow `uuid`, without earlier ones of another dataflow of that name."""
    lives = find_lives(one for one in happenings if one.name not in OUTSIDE)
    places = (place for place, life in enumerate(lives) if life.is_of(uuid))
    return lives[next(places, len(lives)) :]


def _life(life: Life, now: Now, use: Use) -> dict[str, Any]:
    verdict = examine([life], Facts(now_boot=now.boot))
    end = life.last(*END_EVENTS, *_UNIT_ENDS) or life.happenings[-1]
    memory = _peak(life, "held_peak")
    return {
        **_values(life, use, end.at_us),
        "ended_us": end.at_us,
        "status": verdict.status,
        "text": verdict.summary[:_MOST_TEXT],
        "cpu_peak_percent": _peak(life, "cpu_peak"),
        "memory_peak_bytes": use.memory if memory is None else memory,
    }


def _open_life(life: Life, now: Now, use: Use) -> dict[str, Any]:
    return {
        **_values(life, use, now.at_us),
        "ended_us": None,
        "status": "",
        "text": "",
        "cpu_peak_percent": None,
        "memory_peak_bytes": use.memory,
    }


def _values(life: Life, use: Use, until_us: int) -> dict[str, Any]:
    """What lives have that have ended, or not."""
    began_us, ready = life.began_us or life.happenings[0].at_us, life.first("dataflow-started")
    average = None
    if use.cpu_us is not None and until_us > began_us:
        average = round(100 * use.cpu_us / (until_us - began_us), 1)
    ready_us = ready.at_us if ready else None
    return {"began_us": began_us, "ready_us": ready_us, "cpu_average_percent": average}


def _peak(life: Life, key: str) -> int | None:
    """The most that a life has used, None if that is not recorded."""
    end = life.last(*END_EVENTS)
    return _number(end.detail(key)) if end else None


def _number(text: str) -> int | None:
    return parse_number(text) if len(text) <= _MOST_DIGITS else None


def _mark(one: Happening) -> dict[str, Any]:
    return {
        "at_us": one.at_us,
        "kind": MARKS[one.name],
        "event": one.name,
        "node": one.node,
        "text": (one.text or one.name)[:_MOST_TEXT],
    }
