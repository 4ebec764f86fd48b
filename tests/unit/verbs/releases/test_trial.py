"""The files of a trial, and what a reboot at any moment would find."""

import fcntl
import signal
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dora_systemd.adapters.bus.manager import Observer
from dora_systemd.adapters.releases.store import Store, locked, store_root
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.cell.begin import make_lock
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.trial import read_after_wait, read_standing, require_deployable
from tests.unit.fakes.manager import FakeManager, options

UNIT = "dora-robot.service"
OLD, NEW = "20261121T220012", "20261122T220012"


def release_options(release: str) -> RunnerOptions:
    place = f"/var/lib/dora-systemd/releases/robot/{release}/tree"
    return options(dataflow=f"{place}/dataflow.yml", working_directory=place)


def text_of(release: str, user: str = "root") -> str:
    context = UnitContext("/usr/bin/python3", False, user, {})
    properties = unit_properties(release_options(release), context, resolve_settings({}, {}, []))
    return f"{format_unit(properties)}\n[Install]\nWantedBy=multi-user.target\n"


def etc(manager: FakeManager) -> Path:
    return manager.etc / "systemd/system" / UNIT


@pytest.fixture
def store(scope: Scope) -> Store:
    found = Store(store_root(scope.state_root), "robot")
    with locked(found):
        found.release(NEW).mkdir()
    return found


def deployed(manager: FakeManager, active: str = "active") -> None:
    """The old release is enabled and runs."""
    etc(manager).parent.mkdir(parents=True)
    etc(manager).write_text(text_of(OLD))
    manager.enable_unit_files([str(etc(manager))])
    manager.add(release_options(OLD), active, Transient=False, FragmentPath=str(etc(manager)))


def try_new(
    manager: FakeManager,
    scope: Scope,
    store: Store,
    fault: Fault | Exception | None,
    tell: Tell = print,
    how: IfInhibited = IfInhibited.REFUSE,
) -> None:
    """Change to the new release, whose gate finds `fault`."""

    class FakeGate:
        def __init__(self, *_: object) -> None:
            pass

        def run(self, *_: object) -> Fault | None:
            standing = read_standing(manager, scope, UNIT)
            assert standing.path.read_text() == text_of(NEW)
            assert standing.trial == NEW
            if isinstance(fault, Exception):
                raise fault
            return fault

    change = Change(
        *(NEW, text_of(NEW), release_options(NEW), 0, True, "deploy", how), by="doractl deploy"
    )
    standing = read_standing(manager, scope, UNIT)
    change_release(manager, scope, store, standing, change, tell, FakeGate)


def test_a_good_release_is_committed(manager: FakeManager, scope: Scope, store: Store) -> None:
    deployed(manager)
    try_new(manager, scope, store, None)
    standing = read_standing(manager, scope, UNIT)
    assert (standing.current, standing.trial) == (NEW, "")
    assert not standing.path.exists()
    assert [one.is_proved for one in store.known()] == [True]


def test_nothing_that_is_told_stops_the_way_back(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    def refuse(_step: object) -> None:
        raise DoraSystemdError("the gateway was stopped")

    deployed(manager)
    with pytest.raises(DoraSystemdError, match="rolled back: node a") as caught:
        try_new(manager, scope, store, Fault("node a: exit code 1", "a"), refuse)
    assert f"{OLD} runs again" in caught.value.hint
    assert not read_standing(manager, scope, UNIT).path.exists()
    try_new(manager, scope, store, None, refuse)
    assert read_standing(manager, scope, UNIT).current == NEW


def test_a_thread_of_the_gateway_leaves_the_signals_alone(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    deployed(manager)
    before = signal.getsignal(signal.SIGTERM)
    thread = ThreadPoolExecutor(1)
    for fault, told in ((Fault("x"), "x"), (None, "")):
        done = thread.submit(try_new, manager, scope, store, fault)
        assert told in str(done.exception())
    assert signal.getsignal(signal.SIGTERM) == before
    assert read_standing(manager, scope, UNIT).current == NEW
    thread.shutdown()


def test_a_bad_release_leaves_the_disk_as_it_was(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    deployed(manager)
    with pytest.raises(DoraSystemdError, match="node a: exit code 1") as caught:
        try_new(manager, scope, store, Fault("node a: exit code 1", "a"))
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert f"{OLD} runs again" in caught.value.hint
    assert etc(manager).read_text() == text_of(OLD)
    assert not read_standing(manager, scope, UNIT).path.exists()
    assert manager.calls[-1] == ("RestartUnit", UNIT)
    assert [one.is_proved for one in store.known()] == [False]


@pytest.mark.parametrize("active", ["inactive", "failed"])
def test_what_did_not_run_is_not_started(
    manager: FakeManager,
    scope: Scope,
    store: Store,
    active: str,
) -> None:
    deployed(manager, active)
    with pytest.raises(DoraSystemdError):
        try_new(manager, scope, store, Fault("x"))
    assert "RestartUnit" not in [call[0] for call in manager.calls]
    assert ("StopUnit", UNIT) in manager.calls


def test_a_trial_ends_before_a_stop_that_may_take_long(
    manager: FakeManager, scope: Scope, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever waits for the stop may be killed meanwhile, and what was told is told again."""
    deployed(manager, "inactive")
    told: list[str] = []
    run_jobs = manager.run_jobs

    def stop(method: str, units: Sequence[str], observer: Observer | None = None) -> dict[str, str]:
        assert not read_standing(manager, scope, UNIT).path.exists()
        assert observer is not None
        for changes in ({"SubState": "x"}, {}, {"StatusText": "stopping, a left"}):
            observer(changes)
        return run_jobs(method, units)

    monkeypatch.setattr(manager, "run_jobs", stop)
    with pytest.raises(DoraSystemdError):
        try_new(manager, scope, store, Fault("x"), lambda one: told.append(one.text))
    assert ("StopUnit", UNIT) in manager.calls
    assert told.count("stopping what runs now") == 1
    assert "stopping what runs now: a left" in told


def test_who_stops_a_trial_wants_nothing_to_run(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    deployed(manager)
    with pytest.raises(DoraSystemdError):
        try_new(manager, scope, store, Fault("it was stopped", is_stop=True))
    assert "RestartUnit" not in [call[0] for call in manager.calls]


def test_a_commit_that_fails_is_undone(
    manager: FakeManager, scope: Scope, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    deployed(manager)
    manager.disable_unit_files([UNIT])

    def fail(*_: object) -> None:
        raise DoraSystemdError("cannot write it: no space")

    monkeypatch.setattr(manager, "enable_unit_files", fail)
    with pytest.raises(DoraSystemdError, match="no space") as caught:
        try_new(manager, scope, store, None)
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert read_standing(manager, scope, UNIT).current == OLD
    assert [one.is_proved for one in store.known()] == [False], "a rollback would take it"
    store.prove(NEW)
    with pytest.raises(DoraSystemdError, match="no space"):
        try_new(manager, scope, store, None)
    assert [one.is_proved for one in store.known()] == [True], "it has passed another trial"


def test_a_terminal_that_is_gone(manager: FakeManager, scope: Scope, store: Store) -> None:
    deployed(manager)
    gone = OSError(5, "Input/output error")
    with pytest.raises(DoraSystemdError, match="Input/output error") as caught:
        try_new(manager, scope, store, gone)
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert not read_standing(manager, scope, UNIT).path.exists()


def test_a_first_release_is_enabled(manager: FakeManager, scope: Scope, store: Store) -> None:
    try_new(manager, scope, store, None)
    assert read_standing(manager, scope, UNIT).boot.is_enabled


@pytest.mark.parametrize("active", ["failed", "inactive"])
def test_what_start_has_started_and_has_ended_is_unloaded_before_the_trial(
    manager: FakeManager,
    scope: Scope,
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    active: str,
) -> None:
    """Else systemd takes the file of the trial for that of the transient unit, and removes it."""
    manager.add(options(), active)
    trial = read_standing(manager, scope, UNIT).path
    reset_failed = manager.reset_failed

    def reset(unit: str) -> None:
        assert not trial.exists()
        reset_failed(unit)

    monkeypatch.setattr(manager, "reset_failed", reset)
    try_new(manager, scope, store, None)
    assert ("reset", UNIT) in manager.calls
    assert read_standing(manager, scope, UNIT).current == NEW


@pytest.mark.parametrize(
    ("now", "reason"),
    [
        ({"ActiveState": "inactive"}, "it has ended meanwhile"),
        ({"ActiveState": "deactivating", "JobType": "stop"}, "it is being stopped"),
        ({"ActiveState": "active", "JobType": "stop"}, "it is being stopped"),
    ],
)
def test_what_is_stopped_during_a_wait_is_not_started_again(
    manager: FakeManager,
    scope: Scope,
    store: Store,
    now: dict[str, str],
    reason: str,
) -> None:
    deployed(manager)
    lock = scope.cell_directory("robot") / "inhibit.lock"
    lock.parent.mkdir(parents=True)
    make_lock(lock)
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)

        def stop(_step: object) -> None:
            manager.units[UNIT] |= now
            fcntl.flock(file, fcntl.LOCK_UN)

        with pytest.raises(DoraSystemdError, match=f"cannot deploy robot: {reason}") as caught:
            try_new(manager, scope, store, None, stop, IfInhibited.WAIT)
    assert caught.value.code is ExitCode.NOT_RUNNING
    assert "RestartUnit" not in [call[0] for call in manager.calls]
    assert read_standing(manager, scope, UNIT).current == OLD


@pytest.mark.parametrize(
    "now",
    [
        {"ActiveState": "inactive", "JobType": "start"},
        {"ActiveState": "deactivating", "JobType": "restart"},
        {"ActiveState": "activating", "SubState": "auto-restart"},
    ],
)
def test_what_restarts_during_a_wait_is_changed(
    manager: FakeManager, scope: Scope, now: dict[str, str]
) -> None:
    deployed(manager)
    before = read_standing(manager, scope, UNIT)
    manager.units[UNIT] |= now
    assert read_after_wait(manager, scope, before, "deploy").running


def test_killed_right_after_its_commit(manager: FakeManager, scope: Scope) -> None:
    deployed(manager)
    path = read_standing(manager, scope, UNIT).path
    path.parent.mkdir(parents=True)
    path.write_text(text_of(OLD))
    assert read_standing(manager, scope, UNIT).trial == ""


def test_what_start_has_started_is_not_replaced(manager: FakeManager, scope: Scope) -> None:
    manager.add(options())
    with pytest.raises(DoraSystemdError, match="started by doractl start") as caught:
        require_deployable(manager, scope, read_standing(manager, scope, UNIT))
    assert caught.value.code is ExitCode.NAME_IN_USE
