"""The history of the releases that ran of a dataflow, a line for each change. Pure.

The history determines which releases are kept, and which release a rollback takes.
"""

import json
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

from dora_systemd.names import is_release_id

REPLACED, ROLLED_BACK, FAILED = "replaced", "rolled-back", "failed"
INTERRUPTED, REMOVED = "interrupted", "removed"
ENDS = (REPLACED, ROLLED_BACK, FAILED, INTERRUPTED, REMOVED)
"""Why a release no longer runs: FAILED its trial; INTERRUPTED in it, which is no fault of it."""
_BAD = (ROLLED_BACK, FAILED)
_TRIALS = (FAILED, INTERRUPTED)
MOST_LINES = 256
_MOST_BYTES = 800
"""Maximum bytes of a text in a line."""


class Switch(NamedTuple):
    """One change of the release that runs."""

    at_us: int  # CLOCK_REALTIME µs
    former: str  # the release that ended, "" if none ran
    release: str  # the one that runs since, or ""
    how: str  # why `former` ended, one of ENDS
    by: str = ""  # who requested the change; "" if that is not known
    reason: str = ""
    node: str = ""  # the one that failed, or ""
    invocation: str = ""  # of systemd, the life in which `node` failed

    @property
    def is_commit(self) -> bool:
        """Whether `release` has passed a trial with this change."""
        return bool(self.release) and self.how not in (*_TRIALS, REMOVED)


def format_switch(one: Switch) -> bytes:
    """Format a change as one line of the file."""
    value = {
        "at_us": one.at_us,
        "from": one.former,
        "to": one.release,
        "ended": one.how,
        "by": _cut(one.by),
        "reason": _cut(one.reason),
        "node": _cut(one.node),
        "invocation": one.invocation,
    }
    return json.dumps(value).encode() + b"\n"


def parse_history(data: bytes) -> list[Switch]:
    """Parse the changes in the file, oldest first. A partial or damaged line is left out."""
    return [found for line in _whole_lines(data) if (found := _parse(line))]


def count_damaged(data: bytes) -> int:
    """Count the lines that parse_history() leaves out; the partial one of a power cut is none."""
    return sum(_parse(line) is None for line in _whole_lines(data))


def _whole_lines(data: bytes) -> list[bytes]:
    return data.split(b"\n")[:-1]


def completed(history: Sequence[Switch], current: str, at_us: int = 0) -> list[Switch]:
    """The history, with the change that a power cut has kept from being written.

    current: the release that every start runs, or "". at_us: the time of that change, if known.
    """
    last = _last_run(history)
    if not history or not current or last == current:
        return [*history]
    return [*history, Switch(at_us, last, current, how_of(history, current))]


def how_of(history: Sequence[Switch], release: str, known: Collection[str] = ()) -> str:
    """Return why the present release ends when `release` replaces it.

    known: as of runs().
    """
    return ROLLED_BACK if release in runs(history, known)[:-1] else REPLACED


def runs(history: Sequence[Switch], known: Iterable[str] = ()) -> list[str]:
    """Return the releases that ran one after the other, the present one last.

    Releases that a rollback has undone are left out. known: releases that have passed a trial;
    those older than all releases of the history ran before it begins.
    """
    named = {id_ for one in history for id_ in (one.former, one.release) if id_}
    found = sorted(one for one in set(known) if not named or one < min(named))
    for one in history:
        if one.how == REMOVED:
            found = [id_ for id_ in found if id_ != one.former]
        elif one.release in found:
            del found[found.index(one.release) + 1 :]
        elif one.release:
            found.append(one.release)
    return found


def marks(history: Sequence[Switch]) -> dict[str, Switch]:
    """Return the releases that failed a trial or were rolled back from, and how.

    A mark ends when the release passes a later trial, which only a request with its name starts.
    """
    found: dict[str, Switch] = {}
    for one in history:
        if one.how in _BAD and one.former:
            found[one.former] = one
        if one.is_commit:
            found.pop(one.release, None)
        if one.how == REMOVED:
            found.pop(one.former, None)
    return found


def ends(history: Sequence[Switch]) -> dict[str, Switch]:
    """The last end of each release."""
    return {one.former: one for one in history if one.former}


def begins(history: Sequence[Switch]) -> dict[str, int]:
    """Return when each release last began to run, in µs."""
    found: dict[str, int] = {}
    for one in history:
        if one.release and one.former != one.release:
            found[one.release] = one.at_us
    return found


def undone(history: Sequence[Switch]) -> Switch | None:
    """The last change, if it was no new release that has passed its trial."""
    last = next((one for one in reversed(history) if one.how != REMOVED), None)
    return last if last and last.how != REPLACED else None


def kept(history: Sequence[Switch], known: Collection[str]) -> list[Switch]:
    """The changes that stay in a file that has become too long.

    known: all releases in the store; what happened to others alone goes first.
    """
    named = [one for one in history if one.former in known or (one.is_commit and one.release)]
    return named[-MOST_LINES // 2 :]


def _last_run(history: Sequence[Switch]) -> str:
    """The release that runs according to the history, or ""."""
    found = (one.release for one in reversed(history) if one.how != REMOVED)
    return next(found, "")


def _cut(text: str) -> str:
    line = " ".join(text.split())
    return line.encode("utf-8", "replace")[:_MOST_BYTES].decode("utf-8", "ignore")


def _parse(line: bytes) -> Switch | None:
    try:
        value: Any = json.loads(line)
        former, release, how = str(value["from"]), str(value["to"]), str(value["ended"])
        at_us = int(value["at_us"])
        by, reason = str(value["by"]), str(value["reason"])
        node, invocation = str(value["node"]), str(value["invocation"])
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        return None
    is_ours = how in ENDS and all(not one or is_release_id(one) for one in (former, release))
    texts = (by, reason, node, invocation)
    return Switch(at_us, former, release, how, *texts) if is_ours else None


CURRENT, TRIAL, PROVED, UNPROVED = "current", "trial", "proved", "unproved"
UNKNOWN = "unknown"


class Known(NamedTuple):
    """A release in the store."""

    id: str
    is_proved: bool  # whether it has passed a trial


def state_of(one: Known, current: str, trial: str, mark: Switch | None = None) -> str:
    """The state in one word. current: what the unit file on the disk starts. trial: on trial.

    mark: its own of marks().
    """
    if one.id == trial:
        return TRIAL
    if one.id == current:
        return CURRENT
    if mark:
        return mark.how
    return PROVED if one.is_proved else UNPROVED


def before(releases: Sequence[Known], current: str, history: Sequence[Switch] = ()) -> str:
    """The release that ran well before `current`, or "".

    Never one that has failed a trial or was rolled back from since it ran well. current: "" for
    what ran last. history: completed().
    """
    bad = marks(history)
    good = {one.id for one in releases if one.is_proved}
    ran = runs(history, good)
    if current in ran:
        ran = ran[: ran.index(current)]
    return next((one for one in reversed(ran) if one in good and one not in bad), "")


def surplus(
    releases: Sequence[Known],
    keep: int,
    current: str,
    used: Collection[str] = (),
    history: Sequence[Switch] = (),
) -> list[str]:
    """Return the releases to remove, oldest first: all but `keep`.

    Releases that have passed no trial, or were rolled back from, are removed before others, older
    before newer. The current release, the one before it and those of `used` stay in any case.
    """
    bad = marks(history)
    ids = sorted((one.id for one in releases), reverse=True)
    good = [one.id for one in releases if one.is_proved and one.id not in bad]
    ranked = [*sorted(good, reverse=True), *(one for one in ids if one not in good)]
    stay = {*ranked[:keep], current, before(releases, current, history), *used}
    return sorted(one for one in ids if one not in stay)
