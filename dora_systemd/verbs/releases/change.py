"""Changes the release of a dataflow: trial, soak, then commit or the way back.

deploy and rollback both end here, so this is the one place for what may forbid such a change.
"""

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

from dora_systemd.adapters.bus.manager import SETTLED, UP, Manager, Observer
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.guard import SIGNALS, guarded
from dora_systemd.adapters.host.unit_files import remove_unit_file
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.adapters.releases.store import Store, unusable
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.logs.journal_events import ROLLED_BACK
from dora_systemd.decisions.releases.progress import Step, going_back, judged, stopping, waiting
from dora_systemd.decisions.unit.file import is_boot_checked, with_boot_check
from dora_systemd.decisions.why.remedies import known_remedy
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode, words_of
from dora_systemd.names import notice_unit, unit_name
from dora_systemd.scope import Scope
from dora_systemd.values import INFINITY
from dora_systemd.verbs.facts.locks import IfInhibited, uninhibited
from dora_systemd.verbs.releases.soak import START_LIMIT, Gate, Tell, settle
from dora_systemd.verbs.releases.trial import (
    KILLED,
    Standing,
    begin_trial,
    commit,
    end_trial,
    go_back,
    note_fault,
    note_run,
    read_after_wait,
    read_life,
    read_standing,
)
from dora_systemd.verbs.start.start import make_room


@dataclass(frozen=True)
class Change:
    """A release that is to run."""

    release: str
    text: str  # its unit file
    options: RunnerOptions
    soak: int  # µs
    want_boot: bool
    verb: str  # "deploy" or "rollback"
    how: IfInhibited  # what to do while a lock inhibits the change
    by: str  # the command that requests the change, as in note_request()


class Trial(Protocol):
    """The judge of a release: a Gate."""

    def run(self, start_limit: int, soak: int) -> Fault | None:
        """Start it and watch it for `soak` µs; None if all is well. Raises DoraSystemdError."""


MakeTrial = Callable[[Manager, Scope, RunnerOptions, Tell], Trial]


def change_release(
    manager: Manager,
    scope: Scope,
    store: Store,
    standing: Standing,
    change: Change,
    tell: Tell,
    make_trial: MakeTrial = Gate,
) -> None:
    """Run the release, and commit it or roll back. make_trial: gives what judges it.

    Raises DoraSystemdError: ROLLED_BACK if it has failed its trial; INHIBITED before that, and
    NOT_RUNNING if what ran has ended in a wait. SIGINT, SIGTERM and SIGHUP roll back, too.
    """
    running, verb = standing.running, change.verb
    with uninhibited(scope, running, verb, change.how, lambda text: tell(waiting(text))):
        standing = read_after_wait(manager, scope, standing, verb)
        if is_boot_checked(standing.boot.text or ""):
            change = replace(change, text=with_boot_check(change.text))
        for cell in standing.running:
            note_request("stop-asked", cell.name, cell.uuid, change.by)
        if not standing.running:
            # As an ended unit of doractl start is unloaded, systemd would remove the trial's file.
            make_room(manager, standing.boot)
        trial = make_trial(manager, scope, change.options, tell)
        _try(_Attempt(manager, scope, standing, change, tell), store, trial)


@dataclass(frozen=True)
class _Attempt:
    """A change of the standing release. The fields are the arguments of change_release()."""

    manager: Manager
    scope: Scope
    standing: Standing
    change: Change
    tell: Tell


def _try(attempt: _Attempt, store: Store, trial: Trial) -> None:
    manager, scope, tell = attempt.manager, attempt.scope, attempt.tell
    standing, change = attempt.standing, attempt.change
    # After this only the journal and systemd know the state: undo the change in any case.
    mark, life = _Mark(store, change.release), read_life(manager, standing.boot.unit)
    begun = partial(_end_alone, scope, standing, change, life, mark)
    with guarded(begun, store.lock), _interruptible():
        _begin(manager, standing, change.text)
        try:
            fault = trial.run(_limit(change.options), change.soak)
            if fault is None:
                _ignore_signals()
                mark.make()
                commit(manager, standing, change.text, change.want_boot)
        except KeyboardInterrupt:
            fault = Fault("the command was interrupted", is_outside=True)
        except DoraSystemdError as error:
            fault = Fault(error.message, is_outside=True)
        except Exception as error:  # a terminal that is gone, too
            fault = Fault(f"the command failed: {words_of(error)}", is_outside=True)
        if fault is not None:
            _ignore_signals()
            raise _roll_back(attempt, fault, mark)
        note_run(store, standing, change.release, change.by)
        _note_commit(scope, standing, change)
        remove_unit_file(standing.boot.runtime)
        end_trial(manager, standing)
    _calm(tell)(judged(change.release, ""))


def _begin(manager: Manager, standing: Standing, text: str) -> None:
    """Put the release on trial. Raises DoraSystemdError; what runs has not been touched then."""
    try:
        begin_trial(manager, standing, text)
    except (DoraSystemdError, KeyboardInterrupt):
        end_trial(manager, standing)
        raise


def _note_commit(scope: Scope, standing: Standing, change: Change) -> None:
    details = {"scope": scope.word, "release": change.release, "former": standing.current}
    options = change.options
    note_request("release-committed", options.name, options.uuid, change.by, **details)


def _limit(options: RunnerOptions) -> int:
    own = options.start_timeout
    return max(START_LIMIT, own) if own != INFINITY else START_LIMIT


class _Mark:
    """The file that records a passed trial of a release; a failed commit removes it."""

    def __init__(self, store: Store, release: str) -> None:
        self.store = store
        self._release = release
        self._was_there = store.is_proved(release)

    def make(self) -> None:
        """Create the file. Raises DoraSystemdError."""
        try:
            self.store.prove(self._release)
        except OSError as error:
            raise unusable(self.store.release(self._release), error) from error

    def take_back(self) -> None:
        """Remove the file, unless it is from an earlier trial."""
        if not self._was_there:
            with suppress(OSError):  # restoring the former release is more important
                self.store.doubt(self._release)


def _roll_back(attempt: _Attempt, fault: Fault, mark: _Mark) -> DoraSystemdError:
    """Restore the former release; return the error that reports that."""
    manager, standing, change = attempt.manager, attempt.standing, attempt.change
    mark.take_back()
    note_fault(mark.store, standing, change.release, fault, change.by)
    name, former, tell = change.options.name, standing.current, _calm(attempt.tell)
    tell(judged(change.release, fault.reason))
    want_start = standing.was_up and not fault.is_stop
    if not fault.is_stop:
        _note_stop(manager, change)
    now = "nothing of it runs"
    try:
        go_back(manager, standing, want_start, stop_observer(tell))
        if want_start:
            now = f"{former or 'what was there before'} {_back(manager, standing, tell)}"
    except DoraSystemdError as error:
        now = f"the way back has failed, too: {error.message}"
    # The event has the UUID of the life that runs after this.
    uuid, details = change.options.uuid, {"release": change.release, "former": former}
    reasons = {"nodes": fault.node, "reason": fault.reason}
    note_request(ROLLED_BACK, name, uuid, change.by, **details, **reasons)
    _request_notice(manager, change.options)
    return DoraSystemdError(
        f"release {change.release} of {name} was rolled back: {fault.reason}",
        f"{now}; {known_remedy(fault.lines) or f'doractl why {name} shows more'}",
        ExitCode.ROLLED_BACK,
        fault.lines,
    )


def _request_notice(manager: Manager, options: RunnerOptions) -> None:
    """Start the service that sends notices, if the dataflow has any. Its absence fails nothing."""
    if options.is_noticed:
        with suppress(DoraSystemdError):
            manager.queue_job("StartUnit", notice_unit(options.name))


def _end_alone(scope: Scope, standing: Standing, change: Change, life: str, mark: _Mark) -> None:
    # A bus connection does not survive fork(), see sd_bus_new(3).
    end_killed(Bus(scope), scope, standing, change, life, mark)


def end_killed(
    manager: Manager, scope: Scope, standing: Standing, change: Change, life: str, mark: _Mark
) -> None:
    """Restore the former release after this process was killed, unless the new one is committed.

    life: of the unit before the trial. A unit that the trial has not restarted keeps running.
    """
    unit = standing.boot.unit
    now = read_standing(manager, scope, unit)
    if now.current == change.release != standing.current:
        commit(manager, now, change.text, change.want_boot)  # it may lack its link
        note_run(mark.store, standing, change.release, change.by)
        end_trial(manager, now)
        return
    if read_life(manager, unit) == life:
        end_trial(manager, standing)
    # Check again: a restart may have been queued.
    if read_life(manager, unit) != life:
        attempt = _Attempt(manager, scope, standing, change, lambda _: None)
        _roll_back(attempt, Fault(KILLED, is_outside=True), mark)


def _note_stop(manager: Manager, change: Change) -> None:
    """Record who stops the release on trial, if that release still runs."""
    with suppress(DoraSystemdError):
        state = manager.read(unit_name(change.options.name), ["ActiveState"])["ActiveState"]
        if state in UP:
            note_request("stop-asked", change.options.name, change.options.uuid, change.by)


def _calm(tell: Tell) -> Tell:
    """Wrap `tell` so that its exceptions stop neither a commit nor the way back."""

    def tell_on(step: Step) -> None:
        with suppress(Exception):
            tell(step)

    return tell_on


def stop_observer(tell: Tell) -> Observer:
    """Return an observer that reports the stop of the release on trial during the way back."""
    told = _calm(tell)

    def observe(changes: Mapping[str, Any]) -> None:
        status = str(changes.get("StatusText", ""))
        if not changes or "stopping" in status:
            told(stopping(status))

    return observe


def _back(manager: Manager, standing: Standing, tell: Tell) -> str:
    """Format whether the unit is up again."""

    def observe(active: str, status: str) -> None:
        tell(going_back(standing.current, status if active == "activating" else ""))

    state = settle(manager, standing.boot.unit, START_LIMIT, observe)
    return "runs again" if state in SETTLED else f"has not started again: {state}"


@contextmanager
def _interruptible() -> Iterator[None]:
    """Let the signals that would end this process raise KeyboardInterrupt instead."""
    before = {one: signal.getsignal(one) for one in SIGNALS if _takes_signals()}
    for one, handler in before.items():
        if handler is not signal.SIG_IGN:  # as by nohup(1)
            signal.signal(one, _interrupt)
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _interrupt(*_arguments: object) -> None:
    _ignore_signals()  # a session that ends sends two of them
    raise KeyboardInterrupt


def _ignore_signals() -> None:
    """Let nothing interrupt the way back."""
    for one in SIGNALS:
        if _takes_signals():
            signal.signal(one, signal.SIG_IGN)


def _takes_signals() -> bool:
    """Whether this is the main thread; in threads of the gateway, `tell` raises instead."""
    return threading.current_thread() is threading.main_thread()
