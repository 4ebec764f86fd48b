"""What a notice reports, from records of the journal: what has happened since the last notice.

The journal is the only memory of notices. So the record of a notice has the time of the newest
failure in it, and the pause that follows. Times are those of CLOCK_MONOTONIC: the clock of a robot
is often set after its boot.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

from dora_systemd.decisions.life.causes import result_words
from dora_systemd.decisions.life.kills import Kills, life_of
from dora_systemd.decisions.logs.journal_events import (
    BUNDLE_WRITTEN,
    END_EVENTS,
    NOTICE_ENDS,
    ROLLED_BACK,
    STOPPING,
)
from dora_systemd.decisions.logs.query import UNIT_ENDS, UNIT_FAILED
from dora_systemd.names import is_node_id, is_readable, is_uuid
from dora_systemd.values import SECOND, format_duration, format_moment

FAILED = "failed"
_WORDS = {
    ROLLED_BACK: "rolled-back",
    "machine-lost": "machine-lost",
    "node-given-up": "node-given-up",
}
ORDER = (FAILED, *_WORDS.values())
"""The values of DORA_NOTICE_EVENT, the worst first."""

POWER_LOST = "power-lost"
"""The event of a bundle about what ran when the machine went down without a shutdown."""

FIRST_PAUSE = 15 * SECOND
"""Between the first notice and the next one: no minute has more than five."""
LAST_PAUSE = 600 * SECOND
LOOK_BACK = 120 * SECOND
"""Failures before that are not reported, unless the notice before left them to the next one: they
may be older than the setting."""
MOST_RECORDS = 20_000
MOST_ENDS = 100
_MOST_TEXT = 500


class Happened(NamedTuple):
    """One failure."""

    what: str  # one of ORDER
    at_us: int  # CLOCK_REALTIME
    mono_us: int  # CLOCK_MONOTONIC
    node: str = ""
    cause: str = ""
    uuid: str = ""  # of the dataflow, if the failure is FAILED and that is known


class Sent(NamedTuple):
    """The last notice."""

    mono_us: int  # when it was sent, CLOCK_MONOTONIC
    until_us: int  # the newest failure in it, CLOCK_MONOTONIC
    pause_us: int  # between it and the next one


Story = tuple[list[Happened], Sent | None]
"""Failures that no notice has reported, newest first, and the last notice."""


def read_last(records: Iterable[Mapping[str, Any]], boot: str, now_us: int) -> Sent | None:
    """Read the last notice of this boot, as long as a pause can follow it. records: newest first.

    It is read by itself: nodes can write more records than read_story() reads.
    """
    written = islice(records, MOST_ENDS)
    # A bundle that was requested is about no failure.
    for record in islice((one for one in written if "DORA_UNTIL" in one), 1):
        last = _sent(record, _number(record, "__MONOTONIC_TIMESTAMP"))
        if record.get("_BOOT_ID") == boot and now_us - last.mono_us <= 2 * LAST_PAUSE:
            return last
    return None


def read_story(
    records: Iterable[Mapping[str, Any]], boot: str, now_us: int, last: Sent | None = None
) -> Story:
    """Read what has happened. records: newest first. boot: the id of this boot, as journald's.

    last: the last notice, if that is known.
    """
    found: list[Happened] = []
    causes: dict[str, tuple[str, str, str]] = {}
    results: dict[str, str] = {}
    kills = Kills()
    bound = last.until_us if last else now_us - LOOK_BACK
    for record in islice(records, MOST_RECORDS):
        mono_us = _number(record, "__MONOTONIC_TIMESTAMP")
        if record.get("_BOOT_ID") != boot or mono_us <= bound:
            break
        event = str(record.get("DORA_EVENT", ""))
        kills.read(record)
        if event in NOTICE_ENDS:
            if "DORA_UNTIL" not in record:
                continue  # a bundle that was requested
            last = last or _sent(record, mono_us)
            bound = max(bound, last.until_us)
        elif event == "dataflow-failed":
            life = str(record.get("_SYSTEMD_INVOCATION_ID", ""))
            reason = plain(record.get("DORA_REASON", ""))
            causes.setdefault(life, (_first_node(record), reason, _uuid(record)))
        elif one := _happened(record, event, mono_us):
            found.append(one)
            if one.what == FAILED:
                results[one.cause] = result_words(str(record.get("UNIT_RESULT", "")))
    failures = (one for one in found if one.what != FAILED or one.cause not in kills.requested)
    return [_with_cause(one, causes, results) for one in failures], last


def has_lost_power(records: Iterable[Mapping[str, Any]], boot: str) -> bool:
    """Whether a dataflow ran when the machine went down, and no bundle is about that yet.

    records: as of cut_matches(), newest first. boot: the id of this boot.
    """
    for record in islice(records, MOST_ENDS):
        event = record.get("DORA_EVENT", "")
        if record.get("_BOOT_ID") != boot:
            is_end = event in (*END_EVENTS, STOPPING) or record.get("MESSAGE_ID") in UNIT_ENDS
            return not (is_end or event in NOTICE_ENDS)
        if event == BUNDLE_WRITTEN and f"-{POWER_LOST}." in str(record.get("DORA_FILE")):
            return False
    return False


def _sent(record: Mapping[str, Any], mono_us: int) -> Sent:
    return Sent(mono_us, _number(record, "DORA_UNTIL"), _number(record, "DORA_PAUSE"))


def _happened(record: Mapping[str, Any], event: str, mono_us: int) -> Happened | None:
    at_us = _number(record, "__REALTIME_TIMESTAMP")
    if record.get("MESSAGE_ID") == UNIT_FAILED:
        # Each failure of the unit has one such record, also if the runner could write nothing. Its
        # cause is what the runner has written in the same life.
        return Happened(FAILED, at_us, mono_us, cause=life_of(record), uuid=_uuid(record))
    if event not in _WORDS:
        return None
    cause = plain(record.get("DORA_REASON", ""))
    if machine := record.get("DORA_MACHINE"):
        cause = f"machine {plain(machine)}: {cause}"
    return Happened(_WORDS[event], at_us, mono_us, _first_node(record), cause)


def _first_node(record: Mapping[str, Any]) -> str:
    nodes = str(record.get("DORA_NODE") or record.get("DORA_NODES") or "").split()
    return next(filter(is_node_id, nodes), "")


def _uuid(record: Mapping[str, Any]) -> str:
    text = str(record.get("DORA_DATAFLOW", ""))
    return text if is_uuid(text) else ""


def _with_cause(
    one: Happened, causes: Mapping[str, tuple[str, str, str]], results: Mapping[str, str]
) -> Happened:
    """Add what the runner wrote in that life; without that, what the result of systemd means."""
    if one.what != FAILED:
        return one
    node, cause, uuid = causes.get(one.cause, ("", results.get(one.cause, ""), ""))
    # A user's manager does not record the dataflow.
    return one._replace(node=node, cause=cause, uuid=one.uuid or uuid)


def pause_left(last: Sent | None, now_us: int) -> int:
    """µs until the next notice may be sent."""
    return max(last.mono_us + min(last.pause_us, LAST_PAUSE) - now_us, 0) if last else 0


def next_pause(last: Sent | None, now_us: int) -> int:
    """The pause after a notice that is sent now: twice as long as the last one in a storm."""
    if last is None or now_us - last.mono_us > 2 * last.pause_us:
        return FIRST_PAUSE
    return max(min(2 * last.pause_us, LAST_PAUSE), FIRST_PAUSE)


def main_one(happened: Sequence[Happened]) -> Happened:
    """The newest of the worst kind. happened: newest first, at least one.

    What came before a rollback is over: the former release runs again.
    """
    kinds = [one.what for one in happened]
    count = kinds.index(_WORDS[ROLLED_BACK]) + 1 if _WORDS[ROLLED_BACK] in kinds else len(kinds)
    return min(happened[:count], key=lambda one: ORDER.index(one.what))


def summary(name: str, host: str, happened: Sequence[Happened], node: str = "") -> str:
    """One line, such as "robot on arm-3 failed: node detector: exit code 1"."""
    main = main_one(happened)
    node = main.node or node
    texts = {
        FAILED: "failed",
        "rolled-back": "has a release that was rolled back",
        "machine-lost": "has lost a machine",
        "node-given-up": f"has given up node {node}",
    }
    text = f"{name} on {plain(host)} {texts[main.what]}"
    text += f": {main.cause}" if main.cause else ""
    if len(happened) > 1:
        span = (happened[0].mono_us - happened[-1].mono_us) // SECOND * SECOND
        text += f" ({len(happened)} failures within {format_duration(max(span, SECOND))})"
    return plain(text)


def variables(
    name: str, host: str, unit: str, happened: Sequence[Happened], node: str, evidence: str
) -> dict[str, str]:
    """The environment of a notice. node: that `why` names. evidence: path of why.json."""
    main = main_one(happened)
    found = {
        "DATAFLOW": name,
        "UNIT": unit,
        "HOST": plain(host),
        "EVENT": main.what,
        "NODE": main.node or node,
        "CAUSE": main.cause,
        "TIME": format_moment(main.at_us),
        "SINCE": format_moment(happened[-1].at_us),
        "COUNT": str(len(happened)),
        "SUMMARY": summary(name, host, happened, node),
        "EVIDENCE": evidence,
    }
    return {f"DORA_NOTICE_{key}": text for key, text in found.items()}


def plain(value: object) -> str:
    """Return a text of a record as one line that an environment variable can contain.

    Nodes choose parts of it, so a line break must not begin another header or message. A text with
    one is a list of bytes in the journal's JSON.
    """
    if isinstance(value, list):
        numbers = (one for one in value if isinstance(one, int) and 0 <= one < 256)
        value = bytes(numbers).decode("utf-8", "replace")
    text = "".join(one if one.isprintable() and is_readable(one) else " " for one in str(value))
    return " ".join(text.split())[:_MOST_TEXT]


def format_environment(values: Mapping[str, str]) -> str:
    """The variables as a file for EnvironmentFile=, see systemd.exec(5)."""
    return "".join(f'{key}="{_escaped(text)}"\n' for key, text in values.items())


def _escaped(text: str) -> str:
    return "".join(f"\\{one}" if one in '\\"`$' else one for one in text)


def _number(record: Mapping[str, Any], key: str) -> int:
    text = str(record.get(key, ""))
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else 0
