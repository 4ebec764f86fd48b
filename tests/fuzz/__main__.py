"""python -m tests.fuzz SECONDS [TARGET...]: a long round, guided by coverage.

An input that reaches lines which no kept one reaches becomes the beginning of others. One that
breaks a target is kept in corpus/TARGET, and the exit status is 1. No input is kept for its lines:
a corpus of thousands of files helps nobody.
"""

import os
import sys
import time
import traceback
from collections.abc import Sequence
from random import Random
from types import FrameType
from typing import Any

from tests.fuzz.corpus import keep, kept
from tests.fuzz.inputs import PARTS
from tests.fuzz.targets import TARGETS, Target

Lines = set[tuple[str, int]]


def reached(target: Target, data: bytes) -> Lines:
    """The lines of ours that `data` reaches; raises what the target raises."""
    found: Lines = set()

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        file = frame.f_code.co_filename
        if f"{os.sep}dora_systemd{os.sep}" not in file:
            return None
        if event == "line":
            found.add((file, frame.f_lineno))
        return trace

    sys.settrace(trace)
    try:
        target.feed(data)
    finally:
        sys.settrace(None)
    return found


def change(random: Random, pool: Sequence[bytes]) -> bytes:
    """A kept input with pieces of others, of any bytes, or of what readers stumble over."""
    data = random.choice(pool)
    for _ in range(random.randint(1, 5)):
        first = random.randint(0, len(data))
        last = min(first + random.choice((0, 1, 4, 20)), len(data))
        other = random.choice(pool)
        start = random.randint(0, len(other))
        new = (random.choice(PARTS), random.randbytes(2), other[start : start + 30], b"")
        data = data[:first] + random.choice(new) + data[last:]
    return data


def fuzz(name: str, seconds: float, random: Random) -> str:
    """Feed a target for so long; what came of it, in one line."""
    target, pool, known = TARGETS[name], kept(name), Lines()
    for data in pool:
        known |= reached(target, data)
    begun, count, broken = time.monotonic(), 0, 0
    while time.monotonic() - begun < seconds and not broken:
        count += 1
        data = change(random, pool)
        try:
            new = reached(target, data) - known
        except Exception:
            broken += 1
            print(f"{name}: {keep(name, data)}\n{traceback.format_exc(limit=-4)}")
            continue
        if new:
            known |= new
            pool.append(data)
    return f"{name}: {count} inputs, {len(known)} lines, {len(pool)} in the pool, {broken} broken"


def main(arguments: Sequence[str]) -> int:
    """Every target for its share of the time."""
    seconds, names = float(arguments[0]), arguments[1:] or list(TARGETS)
    reports = []
    for name in names:
        reports.append(fuzz(name, seconds / len(names), Random(name)))
        print(reports[-1], flush=True)
    return int(any(not one.endswith(" 0 broken") for one in reports))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
