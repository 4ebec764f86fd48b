"""Collects what the lives of a dataflow show: by node and kind, the numbers that were seen."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.cell.exits import KILLED, parse_exit
from dora_systemd.decisions.cell.owes import STARVED
from dora_systemd.decisions.logs.journal_events import END_EVENTS, NODE_END_EVENTS, NODE_FAILURES
from dora_systemd.decisions.resources.oom import Owner
from dora_systemd.decisions.resources.pressure import CPU, FULL, MEMORY, STALLED
from dora_systemd.decisions.why.lives import Happening, Life, parse_number
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import is_node_id
from dora_systemd.values import INFINITY, SECOND, parse_duration

EVENTS = (
    *("dataflow-starting", "dataflow-started", "dataflow-stopping", *END_EVENTS),
    *(*NODE_END_EVENTS, "node-ready", "node-restarted", "node-stop-late"),
    *("node-silent", "node-speaks-again", "dataflow-oom", MEMORY, CPU),
)
"""The events that show something."""

# Kinds, and their units. A limit is the one that was reached.
HELD, MEMORY_LIMIT = "held", "memory limit"  # bytes
MAPPED = "mapped"  # bytes, with files that processes have mapped
USED, CPU_LIMIT = "used", "cpu limit"  # µs of CPU time per second
RESTART, CRASH = "restart", "crash"  # µs since the process of the node became ready
STOP, CUT_STOP = "stop", "cut stop"  # µs since the stop request; of a stop that was cut short
SILENCE = "silence of "  # and the output; µs of a silence that ended by itself

_PERCENT = SECOND // 100
_MOST_DIGITS = 19


@dataclass(frozen=True)
class Seen:
    """One number that was seen. life: the place of the life, oldest first."""

    value: int
    at_us: int
    life: int


Evidence = Mapping[tuple[str, str], Sequence[Seen]]
"""By node, "" for the dataflow, and by kind; the oldest first."""
_Found = Iterator[tuple[str, str, int, int]]


@dataclass(frozen=True)
class Recorded:
    """The lives in which all nodes became ready."""

    lives: int
    duration_us: int  # of all together
    evidence: Evidence


def collect(lives: Sequence[Life], after: Mapping[str, Sequence[str]], now_us: int = 0) -> Recorded:
    """Collect what the lives show, oldest first.

    after: by node, the nodes that stop before that node. now_us: CLOCK_REALTIME, if the last life
    has not ended; else 0.
    """
    found: dict[tuple[str, str], list[Seen]] = {}
    up = [life for life in lives if life.first("dataflow-started")]
    for number, life in enumerate(up):
        for node, kind, value, at_us in _all(life, after):
            if not node or is_node_id(node):
                found.setdefault((node, kind), []).append(Seen(value, at_us, number))
    spans = [_span(life, now_us if life is lives[-1] else 0) for life in up]
    return Recorded(len(up), sum(spans), found)


def _span(life: Life, now_us: int) -> int:
    begin = life.first("dataflow-started")
    assert begin
    return max(max(now_us, life.happenings[-1].at_us) - begin.at_us, 0)


def _all(life: Life, after: Mapping[str, Sequence[str]]) -> _Found:
    for one in life.happenings:
        yield from _used(one)
        yield from _limits(one)
    yield from _lifetimes(life)
    yield from _stops(life, after)
    yield from _silences(life)


def _number(one: Happening, key: str) -> int:
    """A number in a record, which the owner of a dataflow can write; 0 if it is none."""
    text = one.detail(key)
    return (parse_number(text) or 0) if len(text) <= _MOST_DIGITS else 0


def _used(one: Happening) -> _Found:
    if one.name in (*END_EVENTS, *NODE_END_EVENTS):
        if held := _number(one, "held_peak"):
            yield one.node, HELD, held, one.at_us
        if mapped := _number(one, "mapped_peak"):
            yield one.node, MAPPED, mapped, one.at_us
        if used := _number(one, "cpu_peak"):
            yield one.node, USED, used * _PERCENT, one.at_us
    if one.name == MEMORY and (held := _number(one, "held")):
        yield one.node, HELD, held, one.at_us


def _limits(one: Happening) -> _Found:
    """Which limits were reached, so that what the node would use without them was not seen."""
    limit = _number(one, "limit")
    is_own = one.name == "node-oom" and one.detail("owner") == Owner.NODE.value
    is_waiting = (
        one.name == MEMORY
        and _number(one, "stalled") >= STALLED
        and _number(one, "held") < FULL * limit
    )
    if limit and (is_own or is_waiting or one.name == "dataflow-oom"):
        yield one.node, MEMORY_LIMIT, limit, one.at_us
    if one.name == CPU and (percent := _number(one, "cpu_limit")):
        yield one.node, CPU_LIMIT, percent * _PERCENT, one.at_us


def _lifetimes(life: Life) -> _Found:
    """How long processes of nodes had run when they failed, and when they were restarted."""
    ready: dict[str, int] = {}
    for one in life.happenings:
        if one.name == "node-ready":
            ready[one.node] = one.at_us
        elif one.name in (*NODE_FAILURES, "node-restarted"):
            kind = RESTART if one.name == "node-restarted" else CRASH
            ran = max(one.at_us - ready[one.node], 0) if one.node in ready else 0
            yield one.node, kind, ran, one.at_us


def _stops(life: Life, after: Mapping[str, Sequence[str]]) -> _Found:
    request = life.first("dataflow-stopping")
    if request is None:
        return
    ends: dict[str, Happening] = {}
    late: dict[str, Happening] = {}
    for one in life.happenings:
        if one.at_us >= request.at_us and one.name in ("node-exited", "node-stop-late"):
            (ends if one.name == "node-exited" else late).setdefault(one.node, one)
    for node, end in ends.items():
        others = [ends[other].at_us for other in after.get(node, ()) if other in ends]
        begin = max([request.at_us, *others])
        is_cut = node in late or parse_exit(end.detail("exit")) == KILLED
        until = late.get(node, end).at_us
        yield node, CUT_STOP if is_cut else STOP, max(until - begin, 0), end.at_us


def _silences(life: Life) -> _Found:
    open_: dict[tuple[str, str], tuple[int, int]] = {}
    for one in life.happenings:
        key = one.node, one.detail("output")
        if one.name in NODE_END_EVENTS:  # another process speaks again
            open_ = {other: began for other, began in open_.items() if other[0] != one.node}
        elif one.name == "node-silent" and (allowed := _allowed(one)):
            open_.setdefault(key, (one.at_us, allowed))
        elif one.name == "node-speaks-again" and key in open_:
            began, allowed = open_.pop(key)
            yield one.node, f"{SILENCE}{key[1]}", allowed + max(one.at_us - began, 0), one.at_us


def _allowed(one: Happening) -> int:
    """The time without a message before a silence was reported, 0 for one that does not count.

    A starved node is not at fault, and the time of a first message is another setting.
    """
    text = one.detail("reason")
    _, is_one, time = text.rpartition(" for ")
    if not is_one or STARVED in text:
        return 0
    try:
        allowed = parse_duration(time)
    except DoraSystemdError:
        return 0
    return allowed if allowed < INFINITY else 0


def most(seen: Iterable[Seen]) -> Seen | None:
    """The highest number, the newest of equal ones; None for none."""
    return max(seen, key=lambda one: (one.value, one.at_us), default=None)


def lives_of(seen: Iterable[Seen]) -> int:
    """In how many lives something was seen."""
    return len({one.life for one in seen})
