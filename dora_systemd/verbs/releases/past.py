"""Reads and writes the history of what ran, beside the releases of a dataflow."""

import time
from contextlib import suppress

from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.past import (
    FAILED,
    INTERRUPTED,
    REMOVED,
    Switch,
    completed,
    how_of,
    marks,
)
from dora_systemd.decisions.why.faults import Fault
from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.releases.trial import Standing
from dora_systemd.verbs.start.asked import requester

_MICROSECOND_NS = 1000
KILLED = "the command that tried it was killed"


def read_past(store: Store, current: str) -> list[Switch]:
    """The history, complete. current: what every start runs. Raises DoraSystemdError."""
    return completed(store.history(), current, _now_us())


def note_run(store: Store, standing: Standing, release: str, by: str) -> None:
    """Note that a release has passed its trial. standing: of before. by: as in note_request()."""
    with suppress(DoraSystemdError):
        if _last(store) != release:
            _record(store, standing, [*_begun(store, standing, release, requester(by))])


def note_fault(store: Store, standing: Standing, release: str, fault: Fault, by: str) -> None:
    """Note that a trial has ended with a fault. Arguments as of note_run()."""
    with suppress(DoraSystemdError):
        last = next(reversed(store.history()), None)
        is_noted = last and last.former == release and last.how in (FAILED, INTERRUPTED)
        if not (is_noted and fault.reason == KILLED):
            how = FAILED if fault.is_verdict else INTERRUPTED
            texts = (requester(by), fault.reason, fault.node, fault.invocation)
            switch = (release, standing.current, how, *texts)
            _record(store, standing, [Switch(_now_us(), *switch)])


def note_removal(store: Store, standing: Standing, release: str, by: str) -> None:
    """Note that a release was removed from the store, which is not what runs."""
    switch = (release, standing.current, REMOVED, requester(by))
    _record(store, standing, [Switch(_now_us(), *switch)])


def _begun(store: Store, standing: Standing, release: str, by: str) -> list[Switch]:
    """The changes with which a release takes the place of what there was."""
    now, found = _now_us(), []
    past, former = read_past(store, standing.current), standing.current
    if standing.trial not in ("", release):
        found.append(Switch(now, standing.trial, former, INTERRUPTED, by, KILLED))
    if release != former or release in marks(past):
        good = [one.id for one in store.known() if one.is_proved]
        found.append(Switch(now, former, release, how_of(past, release, good), by))
    return found


def _record(store: Store, standing: Standing, switches: list[Switch]) -> None:
    """Write changes, and before them one that is missing; what runs is worth more than a line."""
    with suppress(DoraSystemdError, OSError):
        history = store.history()
        missing = completed(history, standing.current, _now_us())[len(history) :]
        store.record(*missing, *switches)


def _last(store: Store) -> str:
    found = (one.release for one in reversed(store.history()) if one.how != REMOVED)
    return next(found, "")


def _now_us() -> int:
    return time.time_ns() // _MICROSECOND_NS
