"""Synthetic lives of a dataflow, whose nodes need what the test says: the truth is known.

The events are those of the runner: the same functions make them of samples every 5 seconds.
"""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.resources.oom import Oom, Owner
from dora_systemd.decisions.resources.pressure import Alarms, Load, Most, look
from dora_systemd.decisions.why.lives import Happening, Life
from dora_systemd.values import INFINITY, SECOND, format_duration

STEP = 5 * SECOND
BEGIN = 1_767_225_600 * SECOND


@dataclass(frozen=True)
class Truth:
    """What one node needs: the most bytes, the most µs of CPU time a second, µs to stop.

    jitter: the longest time between two messages, in µs; 0 without an owed output.
    """

    memory: int = 100 << 20
    cpu: int = SECOND // 2
    stop: int = SECOND
    jitter: int = 0


@dataclass(frozen=True)
class Limits:
    """What the node has. within: of the owed output."""

    memory: int = INFINITY
    cpu: int = INFINITY
    stop: int = 10 * SECOND
    within: int = 0


def event(name: str, at_us: int, node: str = "camera", **details: object) -> Happening:
    """An event of a life."""
    texts = {key: str(value) for key, value in details.items()}
    return Happening(name, at_us, node, details=texts)


def live(truth: Truth, limits: Limits, number: int, steps: int = 42, seed: int = 0) -> Life:
    """The life of a dataflow with the node `camera`; number: the place of the life."""
    return Life(tuple(_happenings(truth, limits, random.Random(f"{seed} {number}"), number, steps)))


def _happenings(
    truth: Truth, limits: Limits, chance: random.Random, number: int, steps: int
) -> Iterator[Happening]:
    now = BEGIN + number * 86400 * SECOND
    for name, node in (
        ("dataflow-starting", ""),
        ("node-ready", "camera"),
        ("dataflow-started", ""),
    ):
        yield event(name, now, node)
    alarms: Alarms = {}
    top, most = chance.randrange(steps), Most()
    for step in range(steps):
        now += STEP
        share = 1.0 if step == top else chance.uniform(0.5, 0.97)
        held, wanted = int(truth.memory * share), int(truth.cpu * share)
        if held >= limits.memory:
            oom = Oom(Owner.NODE, limits.memory, limits.memory)
            yield event("node-oom", now, **oom.node_details(), **most.details())
            yield event("node-restarted", now + SECOND)
            yield event("node-ready", now + 2 * SECOND)
            continue
        load = _load(held, wanted, limits)
        most = most.after(load)
        alarms, reports = look(alarms, {"camera": load}, now)
        for name, node, details in reports:
            yield event(name, now, node, **details)
        if truth.jitter and limits.within < truth.jitter * share:
            yield from _silence(int(truth.jitter * share), limits.within, now)
    yield from _stop(truth, limits, now, most)


def _load(held: int, wanted: int, limits: Limits) -> Load:
    limit = None if limits.memory == INFINITY else limits.memory
    is_throttled = limits.cpu < wanted
    used = min(wanted, limits.cpu) / (SECOND / 100)
    if limits.cpu == INFINITY:
        return Load(held, limit, cpu=used)
    share = limits.cpu / (SECOND / 100)
    return Load(held, limit, throttled=90.0 * is_throttled, cpu=used, cpu_limit=share)


def _silence(lasted: int, within: int, now: int) -> Iterator[Happening]:
    words = f"no image for {format_duration(within)}"
    yield event("node-silent", now, output="image", reason=words, then="warn")
    yield event("node-speaks-again", now + lasted - within, output="image", reason="image again")


def _stop(truth: Truth, limits: Limits, now: int, most: Most) -> Iterator[Happening]:
    now += STEP
    yield event("dataflow-stopping", now, "")
    if truth.stop > limits.stop:
        yield event("node-stop-late", now + limits.stop)
    end = now + min(truth.stop, limits.stop + SECOND)
    yield event("node-exited", end, **most.details())
    yield event("dataflow-stopped", end + SECOND // 2, "", **most.details())


def lives_of(
    truth: Truth, limits: Limits, count: int = 5, begin: int = 0, seed: int = 0
) -> Sequence[Life]:
    """Several lives, the oldest first."""
    return [live(truth, limits, begin + number, seed=seed) for number in range(count)]
