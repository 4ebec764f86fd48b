"""The timeline of a dataflow on the status page: its lives, and marks of what happened. Pure.

All of it is read back from journal records, which nodes can write: it is bounded.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from dora_systemd.decisions.logs.journal_events import (
    BUILD_FAILED,
    BUNDLE_REFUSED,
    BUNDLE_WRITTEN,
    END_EVENTS,
    GIVEN_UP,
    ROLLED_BACK,
    START_ASKED,
)
from dora_systemd.decisions.why.lives import Happening, Life, find_lives, parse_number
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


def timeline_values(
    happenings: Sequence[Happening], uuid: str, is_up: bool, now_boot: str
) -> dict[str, Any]:
    """The lives and the marks, oldest first, for JSON; texts are not yet made printable.

    happenings: oldest first. is_up: whether the last life has not ended.
    """
    lives = own_lives(happenings, uuid)[-MOST_LIVES:]
    shown = [
        _life(life, now_boot, is_up and place == len(lives) - 1) for place, life in enumerate(lives)
    ]
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
    places = (place for place, life in enumerate(lives) if _names(life, uuid))
    return lives[next(places, len(lives)) :]


def _names(life: Life, uuid: str) -> bool:
    return any(one.detail("dataflow") == uuid for one in life.happenings)


def _life(life: Life, now_boot: str, is_open: bool) -> dict[str, Any]:
    first, last = life.happenings[0], life.happenings[-1]
    known = {"began_us": life.began_us or first.at_us, "status": "", "text": "", "ended_us": None}
    ready = life.first("dataflow-started")
    known["ready_us"] = ready.at_us if ready else None
    if is_open:
        return {**known, "cpu_peak_percent": None, "memory_peak_bytes": None}
    verdict = examine([life], Facts(now_boot=now_boot))
    end = life.last(*END_EVENTS, *_UNIT_ENDS) or last
    return {
        **known,
        "ended_us": end.at_us,
        "status": verdict.status,
        "text": verdict.summary[:_MOST_TEXT],
        "cpu_peak_percent": _peak(life, "cpu_peak"),
        "memory_peak_bytes": _peak(life, "held_peak"),
    }


def _peak(life: Life, key: str) -> int | None:
    """The most that a life has used, None if that is not recorded."""
    end = life.last(*END_EVENTS)
    text = end.detail(key) if end else ""
    return parse_number(text) if len(text) <= _MOST_DIGITS else None


def _mark(one: Happening) -> dict[str, Any]:
    return {
        "at_us": one.at_us,
        "kind": MARKS[one.name],
        "event": one.name,
        "node": one.node,
        "text": (one.text or one.name)[:_MOST_TEXT],
    }
