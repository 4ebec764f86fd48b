"""Decides what to advise: one rule for each setting, from the evidence and the present settings.

What was seen gets a fifth more. A limit that was reached hides what the node needs, so the advice
is half of that limit more, at least, and the next lives show more. There is no advice as long as
the present value is a tenth above what was seen.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from dora_systemd.decisions.advice.evidence import (
    CPU_LIMIT,
    CRASH,
    CUT_STOP,
    HELD,
    MAPPED,
    MEMORY_LIMIT,
    RESTART,
    SILENCE,
    STOP,
    USED,
    Evidence,
    Recorded,
    Seen,
    lives_of,
    most,
)
from dora_systemd.decisions.cell.limits import SMALLEST_MEMORY
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.values import (
    INFINITY,
    SECOND,
    format_cpu,
    format_duration,
    format_rounded_size,
    format_size,
)

FEWEST_LIVES, SHORTEST_US = 3, 600 * SECOND
"""What must be recorded for an advice: lives, and µs of all together."""
_MORE, _ENOUGH = 1.2, 1.1
_STEP = 1.5
_TOO_MUCH = 2.0
"""A limit of memory that is this much above the advice lets a leak grow for long."""
_FEWEST_CRASHES, _RAN_WELL = 2, 60 * SECOND
"""A restart helps a process that ran well for a while, not one that fails at once."""
_FEWEST_SILENCES, _LONGEST_SILENCE = 3, 4
"""A silence of more than so many times the allowed one is an outage, not a slow output."""
_TIME_STEPS = tuple(1000 * one for one in (5000, 1000, 500, 100, 50, 10, 5))


@dataclass(frozen=True)
class Current:
    """The present settings, by node; "" is the dataflow. What is not known is missing.

    memory, cpu: INFINITY without a limit.
    """

    nodes: frozenset[str] = frozenset()  # those of the dataflow that doractl may restart and limit
    memory: Mapping[str, int] = field(default_factory=dict)
    cpu: Mapping[str, int] = field(default_factory=dict)
    # without nodes whose descriptor has a policy of its own
    policies: Mapping[str, RestartPolicy] = field(default_factory=dict)
    stops: Mapping[str, NodeStop] = field(default_factory=dict)
    grace: int = 10 * SECOND
    stop_limit: int = INFINITY
    owes: tuple[Owed, ...] = ()
    machine_memory: int = INFINITY
    processors: int = 8192


@dataclass(frozen=True)
class Advice:
    """One setting to change."""

    node: str  # "" for the dataflow
    key: tuple[str, ...]  # of the settings file, below the node
    now: str  # the present value, "" if there is none
    value: str
    is_least: bool  # a limit hid how much is needed
    why: str
    seen: tuple[Seen, ...]  # the evidence

    @property
    def place(self) -> tuple[str, ...]:
        """The keys of the settings file; of a list, the item whose `output` is the key."""
        return ("nodes", self.node, *self.key) if self.node else self.key

    @property
    def setting(self) -> str:
        """The keys below the node, as one word."""
        return ".".join(self.key)


def too_little(recorded: Recorded) -> str:
    """Return why there is no advice yet, or ""."""
    if recorded.lives >= FEWEST_LIVES and recorded.duration_us >= SHORTEST_US:
        return ""
    lives = "1 life" if recorded.lives == 1 else f"{recorded.lives} lives"
    return f"too little is recorded: {lives}, {format_span(recorded.duration_us)}"


def format_span(duration: int) -> str:
    """A time in minutes, in seconds if it is less than two, in hours if it is more than two."""
    unit, name = (60, "min") if duration >= 120 * SECOND else (1, "s")
    unit, name = (3600, "h") if duration >= 7200 * SECOND else (unit, name)
    return f"{duration // SECOND // unit} {name}"


def advise(recorded: Recorded, current: Current) -> list[Advice]:
    """The advices, by node; [] if too little is recorded."""
    if too_little(recorded):
        return []
    found = recorded.evidence
    nodes = sorted({node for node, _ in found if node in current.nodes})
    rules: Sequence[Callable[[str, Evidence, Current], Iterator[Advice]]]
    rules = (_memory, _cpu, _policy, _restarts, _stop, _owes)
    of_all = [*_memory("", found, current), *_cpu("", found, current)]
    return of_all + [one for node in nodes for rule in rules for one in rule(node, found, current)]


def _memory(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    now = current.memory.get(node, INFINITY)
    held, reached = found.get((node, HELD), ()), found.get((node, MEMORY_LIMIT), ())
    top, limit = most(held), most(reached)
    is_least = limit is not None and (top is None or limit.value >= top.value)
    seen = limit if is_least else top
    if seen is None or (not node and not is_least and now == INFINITY):
        return  # a limit for all nodes is for those who share a machine, not for every robot
    # What is mapped fills any limit up, so it raises an advice, and is no reason for one.
    mapped = most(found.get((node, MAPPED), ()))
    least = mapped.value * _ENOUGH if mapped else 0
    value = _size(max(seen.value * (_STEP if is_least else _MORE), least))
    is_enough = now >= seen.value * (_STEP if is_least else _ENOUGH)
    is_too_much = now > _TOO_MUCH * value and bool(node)
    if (is_enough and not is_too_much) or value > current.machine_memory:
        return
    if is_least:
        size = format_rounded_size(seen.value)
        why = f"reached its limit of {size} {_times(reached)}"
    else:
        why = f"held at most {format_rounded_size(seen.value)}"
        why += f", {format_rounded_size(mapped.value)} with mapped files" if mapped else ""
    before = "" if now == INFINITY else format_rounded_size(now)
    many = tuple(reached if is_least else held)
    yield Advice(node, ("memory_limit",), before, format_size(value), is_least, why, many)


def _size(value: float) -> int:
    """Round a size up to 32nds of its power of two."""
    size = max(int(value), SMALLEST_MEMORY)
    step = 1 << max(size.bit_length() - 6, 0)
    return -(-size // step) * step


def _cpu(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    now = current.cpu.get(node, INFINITY)
    used, reached = found.get((node, USED), ()), found.get((node, CPU_LIMIT), ())
    top, limit = most(used), most(reached)
    # Within one sample a group can use a little more than its limit.
    is_least = limit is not None and (top is None or limit.value >= top.value * 0.9)
    seen = limit if is_least else top
    if seen is None or now == INFINITY:
        return  # without a limit the scheduler shares the time well
    value = min(_cores(seen.value * (_STEP if is_least else _MORE)), current.processors * SECOND)
    if now >= min(seen.value * (_STEP if is_least else _ENOUGH), value):
        return
    if is_least:
        why = f"throttled by its limit of {format_cpu(seen.value)} {_times(reached)}"
    else:
        why = f"used at most {format_cpu(seen.value)}"
    many = tuple(reached if is_least else used)
    yield Advice(node, ("cpu_limit",), format_cpu(now), format_cpu(value), is_least, why, many)


def _cores(value: float) -> int:
    """Round CPU time up to percents of a processor, if it is little to tenths of them."""
    step = 10_000 if value >= SECOND // 2 else 1000
    return -(-int(value) // step) * step


def _policy(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    policy = current.policies.get(node)
    if policy is None or policy.policy != "no" or (node, RESTART) in found:
        return
    crashes = tuple(one for one in found.get((node, CRASH), ()) if one.value >= _RAN_WELL)
    if len(crashes) < _FEWEST_CRASHES or lives_of(crashes) < _FEWEST_CRASHES:
        return
    shortest = min(one.value for one in crashes)
    why = f"failed {_times(crashes)} after {format_span(shortest)} or more, and stayed down"
    yield Advice(node, ("restart_policy",), "no", "on-failure", False, why, crashes)


def _restarts(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    policy = current.policies.get(node)
    if policy is None or policy.policy == "no" or policy.max_restarts == INFINITY:
        return
    restarts, crashes = found.get((node, RESTART), ()), found.get((node, CRASH), ())
    storm = max(_storms(restarts, crashes, policy.window), key=len, default=())
    worst = len(storm)
    value = worst + max(1, worst // 5)
    if worst < 0.8 * policy.max_restarts or value <= policy.max_restarts:
        return
    span = format_duration(policy.window)
    why = f"recovered after {worst} restarts within {span}, of {policy.max_restarts} it has"
    now = str(policy.max_restarts)
    yield Advice(node, ("max_restarts",), now, str(value), False, why, storm)


def _storms(
    restarts: Sequence[Seen], crashes: Sequence[Seen], window: int
) -> Iterator[tuple[Seen, ...]]:
    """The restarts in each window after which the node did not fail again in that life."""
    for last in restarts:
        storm = tuple(
            one
            for one in restarts
            if one.life == last.life and last.at_us - window < one.at_us <= last.at_us
        )
        until = last.at_us + window
        if not any(one.life == last.life and last.at_us < one.at_us < until for one in crashes):
            yield storm


def _stop(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    own = current.stops.get(node)
    now = own.within if own and own.within else current.grace
    stops, cuts = found.get((node, STOP), ()), found.get((node, CUT_STOP), ())
    top, cut = most(stops), most(cuts)
    is_least = cut is not None and (top is None or cut.value >= top.value)
    seen = cut if is_least else top
    if seen is None:
        return
    value = _time(seen.value * (_STEP if is_least else _MORE))
    if now >= seen.value * (_STEP if is_least else _ENOUGH) or value > current.stop_limit:
        return
    if is_least:
        why = f"had not stopped after {format_duration(_time(seen.value))} {_times(cuts)}"
    else:
        why = f"took up to {format_duration(_time(seen.value))} to stop"
    many = tuple(cuts if is_least else stops)
    before = format_duration(now)
    yield Advice(node, ("stop", "within"), before, format_duration(value), is_least, why, many)


def _owes(node: str, found: Evidence, current: Current) -> Iterator[Advice]:
    for owed in current.owes:
        longest = _LONGEST_SILENCE * owed.within
        silences = found.get((node, f"{SILENCE}{owed.output}"), ())
        short = tuple(one for one in silences if one.value <= longest)
        top = most(short)
        if owed.node != node or top is None or len(short) < _FEWEST_SILENCES:
            continue
        if owed.within < top.value * _ENOUGH:
            value = format_duration(_time(top.value * _MORE))
            times = _times(short)
            why = f"{owed.output} came again by itself {times}, after up to "
            why += format_duration(_time(top.value))
            key = ("owes", owed.output, "within")
            yield Advice(node, key, format_duration(owed.within), value, False, why, short)


def _time(value: float) -> int:
    """Round a time up to what people write, by a fortieth at most."""
    step = next((one for one in _TIME_STEPS if 40 * one <= value), 1000)
    return -(-int(value) // step) * step


def _times(seen: Sequence[Seen]) -> str:
    return "once" if len(seen) == 1 else f"{len(seen)} times"
