"""What must hold of a whole history, whatever happened in it. Pure: it reads a History, no clock.

Each invariant is one function: it gives a complaint for each time that it is broken. None forgives
because something took long: a look that never became quiet is a complaint of its own, which says
how slow the machine was.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from tests.history import lines, lives, views
from tests.history.history import Answer, History
from tests.history.steps import NO_TARGET
from tests.lab.pace import SLOWEST

Invariant = Callable[[History], Iterator[str]]

FLAT_AFTER = 2
"""Looks before a process has all that it needs."""
MOST_DESCRIPTORS = 12
MOST_KIB = 24 * 1024
_OF_PYTHON = ("Traceback (most recent call last)", "[Errno ")
_STATUSES = frozenset({0, 1, *range(3, 12), 130})
"""Those of doractl(1), but for a wrong command line: the table has none."""
_FIXED = "the files of its release"
"""A command line that is wrong only because a release runs, whose files do not change."""


class Complaint(NamedTuple):
    """A broken invariant."""

    invariant: str
    text: str


def quiet_comes(history: History) -> Iterator[str]:
    """After the faults are taken back, everything comes to a state that lasts."""
    for look in history.looks:
        if not look.is_quiet:
            slow = "; the machine is too slow to judge" if look.pace >= SLOWEST else ""
            states = {name: dict(view.unit) for name, view in look.cells.items()}
            yield f"step {look.at}: not quiet, pace {look.pace:.1f}{slow}: {states}"


def answers_are_orderly(history: History) -> Iterator[str]:
    """A doractl ends by itself, with a status of the manual and no words of Python's."""
    for answer in (*history.answers, *history.end):
        text = answer.stderr + answer.stdout
        if any(word in text for word in _OF_PYTHON):
            yield f"step {answer.at}: {answer.step.what}: {text[-800:]}"
        elif _is_doractl(answer) and not _is_known(answer) and not answer.was_hit:
            yield f"step {answer.at}: {answer.step.what} ended with {answer.status}: {text[-400:]}"


def _is_known(answer: Answer) -> bool:
    return answer.status in _STATUSES or (answer.status == 2 and _FIXED in answer.stderr)


def _is_doractl(answer: Answer) -> bool:
    return not answer.step.what.startswith("systemctl")


def an_error_says_something(history: History) -> Iterator[str]:
    """Who fails prints why, to standard error."""
    for answer in history.answers:
        if answer.status and not answer.was_hit and not _has_said(answer):
            yield f"step {answer.at}: {answer.step.what} ended with {answer.status} and no word"


def _has_said(answer: Answer) -> bool:
    return bool(answer.stderr.strip() or answer.stdout.strip()) or answer.status == NO_TARGET


def nothing_is_left(history: History) -> Iterator[str]:
    """After `destroy` and `reset --all` the machine is as it was."""
    yield from (f"left: {one}" for one in history.left)
    for answer in history.end:
        if answer.status and "disable" not in answer.step.what:
            yield f"{answer.step.what}: {answer.status}: {answer.stdout}{answer.stderr}"


def everything_is_flat(history: History) -> Iterator[str]:
    """No process that outlives many steps takes more and more memory or descriptors."""
    for name, series in lives.vital_series(history).items():
        settled = series[FLAT_AFTER:]
        if len(settled) < FLAT_AFTER:
            continue
        first, last = settled[0], settled[-1]
        if last.descriptors - first.descriptors > MOST_DESCRIPTORS:
            yield f"{name}: {first.descriptors} descriptors became {last.descriptors}"
        if last.anonymous - first.anonymous > MOST_KIB:
            yield f"{name}: {first.anonymous} KiB of memory became {last.anonymous} KiB"


def rollbacks_choose_what_ran_well(history: History) -> Iterator[str]:
    """A rollback without a release never runs one that failed, or that one has gone back from."""
    for cell, ran in history.ran.items():
        bad: set[object] = set()
        for one in ran:
            is_trial = one["ended"] in ("failed", "interrupted")
            to, is_rollback = one["to"], "(doractl rollback)" in (one["by"] or "")
            if is_rollback and not is_trial and to != one["from"] and to in bad:
                yield f"{cell}: a rollback from {one['from']} chose {to}, which was known as bad"
            if one["ended"] in ("failed", "rolled-back"):
                bad.add(one["from"])
            if not is_trial:
                bad.discard(to)


INVARIANTS: dict[str, Invariant] = {
    one.__name__: one
    for one in (
        *(lives.one_life_at_a_time, lives.inside_the_unit, lives.restarts_are_counted_once),
        *(views.last_wish_or_reason, views.views_agree, views.nodes_are_real, views.uuid_is_stable),
        *(views.what_a_hand_stops_is_no_failure, views.nodes_obey),
        *(
            views.why_lists_each_restart,
            lines.every_line_once,
            quiet_comes,
            answers_are_orderly,
            an_error_says_something,
        ),
        *(nothing_is_left, everything_is_flat, rollbacks_choose_what_ran_well),
    )
}


def check(history: History) -> list[Complaint]:
    """All complaints about a history."""
    return [
        Complaint(name, text)
        for name, invariant in INVARIANTS.items()
        for text in invariant(history)
    ]
