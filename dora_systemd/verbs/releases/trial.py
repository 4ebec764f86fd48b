"""The unit files of a release on trial, of its commit, and of the way back.

The trial's unit file is in /run/systemd/system.control, see UnitPath in systemd.unit(5): it has
precedence over the one in /etc, which stays as it is, and a reboot removes the trial's file. So
whatever happens in a trial, the machine boots the release that has passed one. read_past() and
note_run() are about the history of releases that ran, a file next to the releases.
"""

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from dora_systemd.adapters.bus.manager import DOWN, Manager, Observer, queued_job
from dora_systemd.adapters.host.unit_files import (
    read_unit_file,
    remains_of,
    remove_unit_file,
    write_unit_file,
)
from dora_systemd.adapters.journal.note import requester
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.releases.past import (
    FAILED,
    INTERRUPTED,
    REMOVED,
    Switch,
    completed,
    how_of,
    marks,
)
from dora_systemd.decisions.unit.file import runner_of
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import release_of
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, read_cell
from dora_systemd.verbs.facts.enabled import trial_path
from dora_systemd.verbs.start.enable import BootUnit, install_unit_file, read_boot_unit
from dora_systemd.verbs.start.start import require_free_name

_RELOADS = 2
"""Tries to reload systemd before the one whose failure counts."""
_MICROSECOND_NS = 1000
KILLED = "the command that tried it was killed"


@dataclass(frozen=True)
class Standing:
    """The state of a dataflow before its release changes."""

    boot: BootUnit  # its unit file
    path: Path  # of the unit file of a trial
    trial: str  # the release on trial, or ""
    cell: Cell | None  # the loaded dataflow, or None
    has_trial: bool  # whether the file of a trial exists

    @property
    def current(self) -> str:
        """The release that a start runs after the trial's unit file is removed, or ""."""
        known = self.boot.options
        if known is None and self.cell is not None and not self.has_trial:
            known = self.cell.options  # disabled while it ran
        return release_of(known.dataflow) if known else ""

    @property
    def has_base(self) -> bool:
        """Whether there is a unit file besides that of the trial."""
        return self.boot.text is not None or self.boot.runtime.exists()

    @property
    def was_up(self) -> bool:
        """Whether something runs that a failed trial has to start again."""
        return self.has_base and self.cell is not None and self.cell.is_up

    @property
    def running(self) -> list[Cell]:
        """The dataflow, if it is up."""
        return [self.cell] if self.cell is not None and self.cell.is_up else []

    @property
    def uuid(self) -> str:
        """The UUID of the dataflow, "" if it is new."""
        known = self.boot.options or (self.cell.options if self.cell else None)
        return known.uuid if known else ""


def trial_options(scope: Scope, unit: str) -> RunnerOptions | None:
    """The runner's options of the release on trial. Raises DoraSystemdError for a foreign file."""
    text = read_unit_file(trial_path(scope, unit))
    return None if text is None else runner_of(text)


def read_standing(manager: Manager, scope: Scope, unit: str) -> Standing:
    """Read the Standing of a dataflow. Raises DoraSystemdError (NAME_IN_USE) for foreign units."""
    options = trial_options(scope, unit)
    boot, path = read_boot_unit(manager, scope, unit), trial_path(scope, unit)
    standing = Standing(boot, path, "", read_cell(manager, unit), path.exists())
    trial = release_of(options.dataflow) if options else ""
    # A deploy that was killed right after its commit has left equal files in both directories.
    return standing if trial == standing.current else replace(standing, trial=trial)


def require_deployable(manager: Manager, scope: Scope, standing: Standing) -> None:
    """Raise DoraSystemdError (NAME_IN_USE) for what a deploy must not replace."""
    cell, unit = standing.cell, standing.boot.unit
    if cell is None or not cell.is_up:
        require_free_name(manager, scope, unit)
    elif manager.read(unit, ["Transient"])["Transient"]:
        raise DoraSystemdError(
            f"cannot deploy {cell.name}: it runs from {cell.options.dataflow}, started by "
            "doractl start",
            f"doractl stop {cell.name}, then deploy again; or choose another --name",
            ExitCode.NAME_IN_USE,
        )


def read_deployable(manager: Manager, scope: Scope, unit: str) -> Standing:
    """Read the Standing of a unit, and check require_deployable()."""
    standing = read_standing(manager, scope, unit)
    require_deployable(manager, scope, standing)
    return standing


def read_after_wait(manager: Manager, scope: Scope, before: Standing, verb: str) -> Standing:
    """Read the Standing after a wait for locks of the dataflows that ran `before`.

    Raises DoraSystemdError: NOT_RUNNING for a dataflow that has ended or is being stopped, because
    the verb would start it again; NAME_IN_USE for a unit that a deploy must not replace.
    """
    for cell in before.running:
        now = next(iter(manager.list_units(cell.unit)), None)
        is_stopping = now is not None and now.job == "stop"
        if now is None or is_stopping or (now.active in DOWN and not now.is_held):
            reason = "it is being stopped" if is_stopping else "it has ended meanwhile"
            hint = f"run doractl {verb} again if it is to run"
            message = f"cannot {verb} {cell.name}: {reason}"
            raise DoraSystemdError(message, hint, ExitCode.NOT_RUNNING)
    return read_deployable(manager, scope, before.boot.unit)


def begin_trial(manager: Manager, standing: Standing, text: str) -> None:
    """Make the next start of the unit run the release. Raises DoraSystemdError."""
    write_unit_file(standing.path, text)
    _reload(manager)


def commit(manager: Manager, standing: Standing, text: str, want_boot: bool) -> None:
    """Make every start run the release, by a rename on the disk.

    want_boot: enable it as well, unless it is. Raises DoraSystemdError; then nothing has changed.
    """
    if want_boot and not standing.boot.is_enabled:
        install_unit_file(manager, standing.boot, text)
    else:
        write_unit_file(standing.boot.path, text)


def end_trial(manager: Manager, standing: Standing) -> None:
    """Let the unit file on the disk take effect again. Raises DoraSystemdError."""
    remove_unit_file(standing.path)
    _reload(manager)


def go_back(
    manager: Manager, standing: Standing, want_start: bool, observe: Observer | None = None
) -> None:
    """End the trial, and start what ran before; without that, stop the unit.

    Does not wait for the start. observe: called now and then during a stop. Raises
    DoraSystemdError.
    """
    unit = standing.boot.unit
    # The trial ends first, because this process may be killed during a long stop. But a unit
    # without any other file would lose what its stop needs.
    if standing.has_base:
        end_trial(manager, standing)
    if not want_start:
        manager.run_jobs("StopUnit", [unit], observe)
    if not standing.has_base:
        end_trial(manager, standing)
    with suppress(DoraSystemdError):  # a unit that is gone has nothing to reset
        manager.reset_failed(unit)
    if want_start:
        manager.queue_job("RestartUnit", unit)


def read_life(manager: Manager, unit: str) -> str:
    """Return a text that changes as soon as systemd starts the unit or queues a start."""
    facts = manager.read(unit, ["InvocationID", "Job"])
    return f"{bytes(facts['InvocationID'] or b'').hex()} {queued_job(facts)}"


def _reload(manager: Manager) -> None:
    """Have systemd load its unit files; on a loaded machine that can take longer than a call."""
    for _ in range(_RELOADS):
        with suppress(DoraSystemdError):
            manager.reload()
            return
    manager.reload()


def remains(store: Store, standing: Standing) -> Iterator[Path]:
    """Find what a killed deploy or rollback has left: doctor names it, clean() removes it."""
    used = {store.release(one) for one in (standing.current, standing.trial) if one}
    yield from (path for path in store.unfinished() if path not in used)
    for place in (standing.boot.path, standing.path):
        yield from remains_of(place)


def read_past(store: Store, current: str) -> list[Switch]:
    """The history, complete. current: what every start runs. Raises DoraSystemdError."""
    return completed(store.history(), current, _now_us())


def note_run(store: Store, standing: Standing, release: str, by: str) -> None:
    """Record a passed trial. standing: before the trial. by: as in note_request()."""
    with suppress(DoraSystemdError):
        if _last(store) != release:
            _record(store, standing, [*_begun(store, standing, release, requester(by))])


def note_fault(store: Store, standing: Standing, release: str, fault: Fault, by: str) -> None:
    """Record that a trial has ended with a fault. Arguments as of note_run()."""
    with suppress(DoraSystemdError):
        last = next(reversed(store.history()), None)
        is_noted = last and last.former == release and last.how in (FAILED, INTERRUPTED)
        if not (is_noted and fault.reason == KILLED):
            how = FAILED if fault.is_verdict else INTERRUPTED
            texts = (requester(by), fault.reason, fault.node, fault.invocation)
            switch = (release, standing.current, how, *texts)
            _record(store, standing, [Switch(_now_us(), *switch)])


def note_removal(store: Store, standing: Standing, release: str, by: str) -> None:
    """Record that a release that does not run was removed from the store."""
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
