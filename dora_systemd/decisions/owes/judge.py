"""Decides which nodes are silent. Pure: each look contains its time.

A node is silent when no message of an owed output has arrived for `within`, or none for `first`
after its start. Time counts only while both runner and probe have run: at most `tick` for each
look, and nothing while the probe does not write its beat. So none of these is a silence of a node:
a suspended machine, a cell that a signal or the freezer has stopped, a clock that was set, a runner
or a probe that gets no CPU time.

A silent node whose own inputs are silent is starved, see probe.py: its process is not at fault.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from dora_systemd.decisions.cell.owes import STARVED, Owed
from dora_systemd.decisions.owes.probe import NO_FEEDS, Feeds, Flow, starved_of
from dora_systemd.values import SECOND, format_duration

_LOOKS = 8
"""Looks within the shortest time that any node has."""
_SHORTEST_TICK, _LONGEST_TICK = SECOND // 40, SECOND
_EARLY = SECOND // 5
"""µs by which a first message may precede dora's report that the process is ready: less than the
delay before a restart, in which no process of the node sends messages."""
BEATS = 2
"""Ticks after which a probe that has not written its beat counts as stopped."""


@dataclass(frozen=True)
class Look:
    """The facts that are known at one moment."""

    # at_us, beat_us, `heard`: CLOCK_MONOTONIC, 0 is never
    at_us: int
    beat_us: int  # the last beat of the probe
    heard: Sequence[int]  # the last message of each slot of Feeds
    lives: Mapping[str, int]  # by node that runs, when its process became ready
    probe: int = 0  # the number of the probe that has written the beat


@dataclass(frozen=True)
class Ear:
    """The state of one owed output. Times in µs."""

    life: int = 0  # when the process that owes it became ready, 0 if none runs
    heard: int = 0  # the last message
    has_come: bool = False  # whether this process has sent one
    quiet: int = 0  # time that counts, without a message
    is_judged: bool = False  # this silence has been reported
    is_silent: bool = False  # no message has arrived since a silence was reported
    silent_us: int = 0  # when the silence was reported
    flows: tuple[Flow, ...] = ()  # the inputs of the node
    starved: str = ""  # the input, NODE/OUTPUT, that the silence comes from, or ""


@dataclass(frozen=True)
class Verdict:
    """A node has fallen silent, or it speaks again."""

    owed: Owed
    is_silent: bool
    words: str  # such as "no image for 2s"
    is_starved: bool = False  # the node is silent because it gets nothing


@dataclass(frozen=True)
class Judge:
    """The state of the watch over `owes`."""

    owes: tuple[Owed, ...]
    ears: tuple[Ear, ...] = ()
    at_us: int = 0  # the last look, 0 before the first
    probe: int = 0  # the number of the probe at the last look
    feeds: Feeds = NO_FEEDS  # what the nodes get

    @property
    def tick(self) -> int:
        """µs between two looks."""
        shortest = min(min(one.within, one.first) for one in self.owes)
        return min(max(shortest // _LOOKS, _SHORTEST_TICK), _LONGEST_TICK)

    def silent_of(self, node: str) -> str:
        """Return the outputs that a node owes now (human-readable), or ""."""
        pairs = zip(self.owes, self.ears, strict=True)
        return ", ".join(
            silence(own, ear) for own, ear in pairs if own.node == node and ear.is_silent
        )


def silence(owed: Owed, ear: Ear) -> str:
    """Format what is missing (human-readable), with the allowed time: so the text is stable."""
    why = f"{STARVED}{ear.starved}" if ear.starved else ""
    if ear.has_come:
        return f"no {owed.output} for {format_duration(owed.within)}{why}"
    return f"no {owed.output} within {format_duration(owed.first)} of its start{why}"


def look(judge: Judge, now: Look) -> tuple[Judge, tuple[Verdict, ...]]:
    """Judge the outputs at one moment; return the next Judge, and what has changed."""
    step = min(max(now.at_us - judge.at_us, 0), judge.tick) if judge.at_us else 0
    if now.at_us - now.beat_us > BEATS * judge.tick:
        step = 0
    before = judge.ears or (Ear(),) * len(judge.owes)
    if now.probe != judge.probe:  # messages between two probes were not received
        step, before = 0, tuple(map(_unheard, before))
    ears: list[Ear] = []
    verdicts: list[Verdict] = []
    for owed, ear, heard in zip(judge.owes, before, now.heard, strict=False):
        fed = _fed(judge.feeds, owed, ear, now.heard, step)
        after = _listen(fed, now.lives.get(owed.node, 0), heard, step)
        after = _judged(owed, after, now.at_us, judge)
        verdicts += _verdicts(owed, ear, after, now.at_us)
        ears.append(after)
    return replace(judge, ears=tuple(ears), at_us=now.at_us, probe=now.probe), tuple(verdicts)


def _unheard(ear: Ear) -> Ear:
    return replace(ear, quiet=0, flows=tuple(replace(one, quiet=0) for one in ear.flows))


def _fed(feeds: Feeds, owed: Owed, ear: Ear, heard: Sequence[int], step: int) -> Ear:
    """Return the ear with the state of its node's inputs.

    When a starved node receives input again, the time for its next output begins.
    """
    slots = feeds.by_node.get(owed.node, ())
    known = ear.flows or (Flow(),) * len(slots)
    flows = tuple(
        flow.after(heard[slot], step, owed.within) for flow, slot in zip(known, slots, strict=True)
    )
    fresh = {feeds.places[slot] for flow, slot in zip(flows, slots, strict=True) if not flow.quiet}
    if ear.starved in fresh:
        ear = replace(ear, starved="", is_judged=False, quiet=0)
    return replace(ear, flows=flows)


def _listen(ear: Ear, life: int, heard: int, step: int) -> Ear:
    if life != ear.life:  # another process, or none
        ear = replace(ear, life=life, has_come=False, quiet=-step, is_judged=False, starved="")
        is_new = life > 0 and heard > max(life - _EARLY, 0)
    else:
        is_new = life > 0 and heard > ear.heard
    if is_new:
        fresh = replace(ear, has_come=True, quiet=0, is_judged=False, is_silent=False, starved="")
        return replace(fresh, heard=heard)
    return replace(ear, heard=max(heard, ear.heard), quiet=ear.quiet + step if life else 0)


def _judged(owed: Owed, ear: Ear, at_us: int, judge: Judge) -> Ear:
    allowed = owed.within if ear.has_come else owed.first
    if not ear.life or ear.is_judged or ear.quiet <= allowed:
        return ear
    since_us = ear.silent_us if ear.is_silent else at_us
    starved = _starved(owed, ear, judge)
    return replace(ear, is_judged=True, is_silent=True, silent_us=since_us, starved=starved)


def _starved(owed: Owed, ear: Ear, judge: Judge) -> str:
    """The input, NODE/OUTPUT, that a silent node lacks, or ""."""
    is_whole = owed.node in judge.feeds.whole
    at = starved_of(ear.flows, ear.quiet, judge.tick, owed, not ear.has_come, is_whole)
    return "" if at is None else judge.feeds.places[judge.feeds.by_node[owed.node][at]]


def _verdicts(owed: Owed, before: Ear, after: Ear, at_us: int) -> Iterator[Verdict]:
    if after.is_judged and not (before.is_judged and before.life == after.life):
        yield Verdict(owed, True, silence(owed, after), bool(after.starved))
    if before.is_silent and not after.is_silent:
        lasted = (at_us - before.silent_us) // SECOND * SECOND
        words = f"{owed.output} again" + (f" after {format_duration(lasted)}" if lasted else "")
        yield Verdict(owed, False, words)
