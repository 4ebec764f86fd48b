"""The invariant of the numbered lines. Pure."""

from collections import defaultdict
from collections.abc import Iterator, Sequence

from tests.history.history import History
from tests.history.steps import FAULTS

REPEATS = 20
"""Lines of one life that may be there twice, where the runner is killed between a line and the note
that it has been written; tests/system/faults has the same number."""


_MOST_BEHIND = 16
"""Lines that a runner may have before it when it is killed."""


def every_line_once(history: History) -> Iterator[str]:
    """Every line that a node printed is in the journal once and in order, or counted as lost."""
    found: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for line in history.lines:
        found[line.cell, line.life].append(line.number)
    missing: defaultdict[str, int] = defaultdict(int)
    for (cell, life), count in history.printed.items():
        numbers = found[cell, life]
        missing[cell] += len(set(range(1, count + 1)) - set(numbers))
        yield from (f"{cell}: {life}: {text}" for text in _wrong(history, cell, numbers))
    if (nameless := sum(not line.has_unit for line in history.lines)) and not _forgets(history):
        yield f"journald does not know the unit of {nameless} lines"
    for cell, count in missing.items():
        if count > history.lost.get(cell, 0) + _MOST_BEHIND * _has_no_successor(history, cell):
            counted = history.lost.get(cell, 0)
            gaps = _gaps(history, cell)
            yield f"{cell}: {count} lines are missing, {counted} are counted: {gaps}"


def _has_no_successor(history: History, cell: str) -> bool:
    """Whether a runner was killed, and systemd could start no other: the project was away."""
    hits = [one.step.what for one in history.answers if one.step.cell == cell and not one.status]
    return "project-deleted" in hits and _kills_runner(hits)


def _forgets(history: History) -> bool:
    """Whether journald was restarted, and a runner killed: of a process that has ended since the
    line was sent, a new journald finds no unit."""
    hits = [one.step.what for one in history.answers if one.status == 0]
    return "journald-restarts" in hits and _kills_runner(hits)


def _kills_runner(hits: Sequence[str]) -> bool:
    return any(what in FAULTS and FAULTS[what].kills_runner for what in hits)


def _wrong(history: History, cell: str, numbers: Sequence[int]) -> Iterator[str]:
    unique = list(dict.fromkeys(numbers))
    if unique != sorted(unique):
        yield "its lines are not in order"
    repeats = len(numbers) - len(unique)
    if repeats > REPEATS * _deaths(history, cell):
        yield f"{repeats} lines are there twice"


def _deaths(history: History, cell: str) -> int:
    hits = (one.step for one in history.answers if one.status == 0 and one.step.cell == cell)
    return sum(step.what in FAULTS and FAULTS[step.what].kills_runner for step in hits)


def _gaps(history: History, cell: str) -> str:
    """Which lives lack how many lines, and after which number."""
    there: defaultdict[str, set[int]] = defaultdict(set)
    for line in history.lines:
        if line.cell == cell:
            there[line.life].add(line.number)
    gaps = []
    for (owner, life), count in history.printed.items():
        lacking = sorted(set(range(1, count + 1)) - there[life]) if owner == cell else []
        if lacking:
            gaps.append(f"{life} lacks {len(lacking)} of {count}, first {lacking[0]}")
    return "; ".join(gaps)
