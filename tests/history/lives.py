"""Invariants of processes and lives. Pure."""

from collections import defaultdict
from collections.abc import Iterable, Iterator

from tests.history.history import History, Look, Sight, Vital
from tests.history.steps import CELLS, COMMANDS


def sights_of(history: History, cell: str) -> Iterator[Sight]:
    """Everything seen of one cell, in the order in which it was seen."""
    for scan in history.sights:
        yield from (sight for sight in scan if sight.cell == cell)


def one_life_at_a_time(history: History) -> Iterator[str]:
    """A process of an earlier life is never seen after one of a later life.

    Only the runner and what it runs itself have an INVOCATION_ID. All others are younger than the
    runner of their life, so an older one belongs to an earlier life.
    """
    for cell in CELLS:
        sights = list(sights_of(history, cell))
        floors = _floors(sights)
        newest, told = 0, set[int]()
        for sight in sights:
            newest = max(newest, floors.get(sight.invocation, 0))
            if sight.began < newest and sight.pid not in told:
                told.add(sight.pid)
                yield f"{cell}: {sight} is older than the life that was seen before it"


def _floors(sights: Iterable[Sight]) -> dict[str, int]:
    """When the first process of each invocation began."""
    floors: dict[str, int] = {}
    for sight in sights:
        if sight.invocation:
            floors[sight.invocation] = min(floors.get(sight.invocation, sight.began), sight.began)
    return floors


def inside_the_unit(history: History) -> Iterator[str]:
    """Every process that comes from a dataflow is in the cgroup of its unit."""
    for cell in CELLS:
        for sight in sights_of(history, cell):
            if f"dora-{cell}.service" not in sight.group.split("/"):
                yield f"{cell}: {sight} is outside of its unit"


def restarts_are_counted_once(history: History) -> Iterator[str]:
    """A unit has no more lives than it was started and restarted.

    The counter of a unit that does not run any more may be gone, and one that was started anew
    counts from 0 again: what systemd has said of its restarts counts, too.
    """
    for cell in CELLS:
        for before, after in zip(history.looks, history.looks[1:], strict=False):
            if after.cells[cell].unit["ActiveState"] == "inactive":
                continue
            seen = _new_lives(history, cell, before, after)
            said = sum(before.at_s < at <= after.at_s for at in history.restarts.get(cell, ()))
            restarts = max(_restarts(cell, before, after), said)
            allowed = _starts(history, cell, before, after) + restarts
            if seen > allowed and not _was_reset(history, cell, before, after):
                yield f"{cell}: {seen} lives from step {before.at} to {after.at}, not {allowed}"


def _was_reset(history: History, cell: str, before: Look, after: Look) -> bool:
    """Whether `doractl reset` has set systemd's counter to 0: nobody can count then."""
    asked = (one.step for one in history.answers if before.at < one.at < after.at)
    return any(step.what == "reset" and step.cell == cell for step in asked)


def _new_lives(history: History, cell: str, before: Look, after: Look) -> int:
    first: dict[str, float] = {}
    for scan in history.sights:
        for sight in scan:
            if sight.cell == cell and sight.invocation:
                first.setdefault(sight.invocation, sight.seen_s)
    return sum(before.at_s < seen <= after.at_s for seen in first.values())


def _starts(history: History, cell: str, before: Look, after: Look) -> int:
    asked = (one for one in history.answers if before.at < one.at < after.at)
    return sum(
        command.lives
        for one in asked
        if one.step.cell == cell and (command := COMMANDS.get(one.step.what))
    )


def _restarts(cell: str, before: Look, after: Look) -> int:
    """A new start of the unit counts from 0 again, so a number that fell says little: all of it."""
    old, new = (int(one.cells[cell].unit.get("NRestarts") or 0) for one in (before, after))
    return new - old if new >= old else new


def vital_series(history: History) -> dict[str, list[Vital]]:
    """What each process held at each look; a process that was started anew is another one.

    PID 1 holds more for each unit that runs, so only looks with as many are compared.
    """
    found: defaultdict[str, list[Vital]] = defaultdict(list)
    for look in history.looks:
        up = sum(view.unit["ActiveState"] == "active" for view in look.cells.values())
        for name, one in look.vitals.items():
            beside = f" beside {up} dataflows" if one.pid == 1 else ""
            found[f"{name} (pid {one.pid}, {one.began}){beside}"].append(one)
    return dict(found)
