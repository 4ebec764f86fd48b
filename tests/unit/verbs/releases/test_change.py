"""Signals, locks and nodes that wait while a release changes, with the real gate."""

import fcntl
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.releases.progress import Step
from dora_systemd.decisions.unit.file import with_boot_check
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.cell.begin import make_lock
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.releases.change import Change, change_release
from dora_systemd.verbs.releases.deploy import Deployed, deploy
from dora_systemd.verbs.releases.rollback import roll_back
from dora_systemd.verbs.releases.trial import read_standing
from tests.unit.fakes.deploys import Bench
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import FakeManager
from tests.unit.verbs.releases.test_trial import (
    NEW,
    OLD,
    UNIT,
    deployed,
    etc,
    release_options,
    store,
    text_of,
    try_new,
)

__all__ = ["store"]


class Interrupted(FakeManager):
    """Sends this process a signal at a moment of the change.

    moment: "trial", "commit" or "way back". state: of the unit after the first restart.
    """

    def __init__(self, etc: FakeManager, moment: str, state: str) -> None:
        super().__init__()
        self.etc, self.moment, self.state = etc.etc, moment, state

    def queue_job(self, method: str, unit: str) -> str:
        is_back = (method, unit) in self.calls
        job = super().queue_job(method, unit)
        self.units[unit]["ActiveState"] = "active" if is_back else self.state
        self._come("way back" if is_back else "trial")
        return job

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        if self.calls:
            self._come("commit")
        return super().enable_unit_files(names)

    def _come(self, moment: str) -> None:
        if moment == self.moment:
            for one in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
                os.kill(os.getpid(), one)


@pytest.mark.parametrize(
    ("moment", "state", "reason"),
    [
        ("trial", "active", "the command was interrupted"),
        ("way back", "failed", "exit code 0"),
        ("commit", "active", ""),
    ],
)
def test_signals(
    manager: FakeManager, scope: Scope, store: Store, moment: str, state: str, reason: str
) -> None:
    """The trial ends at once; neither a commit nor the way back stops in the middle."""
    interrupted = Interrupted(manager, moment, state)
    deployed(interrupted)
    interrupted.hold(UNIT)  # as a unit with a file
    interrupted.calls.clear()
    change = Change(
        *(NEW, text_of(NEW), release_options(NEW), 0, True, "deploy", IfInhibited.REFUSE),
        by="doractl deploy",
    )
    before = read_standing(interrupted, scope, UNIT)
    error: BaseException | None = None
    try:
        change_release(interrupted, scope, store, before, change, lambda _: None)
    except (DoraSystemdError, KeyboardInterrupt) as raised:
        error = raised
    after = read_standing(interrupted, scope, UNIT)
    assert not after.path.exists()
    if not reason:
        assert (error, after.current) == (None, NEW)
        return
    assert isinstance(error, DoraSystemdError)
    assert error.code is ExitCode.ROLLED_BACK
    assert error.message.endswith(reason)
    assert (after.current, interrupted.units[UNIT]["ActiveState"]) == (OLD, "active")
    assert f"{OLD} runs again" in error.hint


def test_a_boot_check_outlives_the_release(
    manager: FakeManager, scope: Scope, store: Store
) -> None:
    deployed(manager)
    etc(manager).write_text(with_boot_check(text_of(OLD)))
    manager.hold(UNIT)
    change = Change(
        *(NEW, text_of(NEW), release_options(NEW), 0, False, "deploy", IfInhibited.REFUSE),
        by="doractl deploy",
    )
    change_release(
        manager, scope, store, read_standing(manager, scope, UNIT), change, lambda _: None
    )
    assert etc(manager).read_text() == with_boot_check(text_of(NEW))


def test_a_mark_that_cannot_be_made(manager: FakeManager, scope: Scope, store: Store) -> None:
    """As where somebody has removed the release meanwhile."""
    deployed(manager)
    store.release(NEW).rmdir()
    with pytest.raises(DoraSystemdError) as caught:
        try_new(manager, scope, store, None)
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert f"cannot use {store.release(NEW)}: " in caught.value.message
    assert etc(manager).read_text() == text_of(OLD)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A dataflow with two releases, of which the newer one runs."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    bench = Bench(tmp_path)
    for text in ("", "print()"):
        bench.write("a.py", text)
        bench.deploy()
    bench.write("a.py", "print(2)")
    bench.steps.clear()
    bench.manager.calls.clear()
    return bench


Act = Callable[[Bench, IfInhibited, bool], Deployed]


def deploy_it(bench: Bench, how: IfInhibited, may_wait: bool = False) -> Deployed:
    request = replace(bench.request(), how=how, may_wait=may_wait)
    return deploy(bench.manager, bench.scope, request, bench.steps.append, bench.warnings.append)


def roll_it_back(bench: Bench, how: IfInhibited, may_wait: bool = False) -> Deployed:
    told, by = bench.steps.append, "doractl rollback"
    return roll_back(bench.manager, bench.scope, "robot", None, 0, told, how, by, may_wait)


@contextmanager
def locked_cell(bench: Bench) -> Iterator[Callable[[], None]]:
    """Hold the lock of the dataflow; gives what gives it back."""
    lock = bench.scope.cell_directory("robot") / "inhibit.lock"
    lock.parent.mkdir(parents=True)
    make_lock(lock)
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield lambda: fcntl.flock(file, fcntl.LOCK_UN)


class Told(list[Step]):
    """Steps; tell: is called with the text of each."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__()
        self.tell = tell

    def append(self, step: Step) -> None:
        super().append(step)
        self.tell(step.text)


ACTS = [("deploy", deploy_it), ("rollback", roll_it_back)]


@pytest.mark.parametrize(("verb", "act"), ACTS)
def test_a_lock_refuses_it(bench: Bench, verb: str, act: Act) -> None:
    """Before anything is copied, checked or stopped."""
    with locked_cell(bench), pytest.raises(DoraSystemdError) as caught:
        act(bench, IfInhibited.REFUSE, False)
    assert caught.value.code is ExitCode.INHIBITED
    assert caught.value.message.startswith(f"cannot {verb} robot: inhibited by ")
    assert (bench.manager.calls, len(bench.releases)) == ([], 2)
    assert not [one for one in bench.texts if one.startswith("copying")]


@pytest.mark.parametrize(("verb", "act"), ACTS)
def test_it_waits_for_the_end_of_a_lock(bench: Bench, verb: str, act: Act) -> None:
    with locked_cell(bench) as release:

        def tell(text: str) -> None:
            if text.endswith("waiting for its end"):
                release()

        bench.steps = Told(tell)
        done = act(bench, IfInhibited.WAIT, False)
    first = next(one for one in bench.texts if "inhibited" in one)
    assert first.startswith(f"cannot {verb} robot: inhibited by ")
    assert bench.releases[done.release] == "current"


@pytest.mark.parametrize("how", [IfInhibited.REFUSE, IfInhibited.WAIT])
def test_a_lock_of_a_first_trial_that_was_killed(bench: Bench, how: IfInhibited) -> None:
    """It may have begun to drive."""
    trial = bench.manager.paths[0]
    trial.parent.mkdir(parents=True, exist_ok=True)
    bench.manager.paths[1].rename(trial)
    bench.manager.units[UNIT] |= {"FragmentPath": str(trial)}
    with locked_cell(bench) as release:
        bench.steps = Told(lambda text: release() if "waiting for its end" in text else None)
        if how is IfInhibited.WAIT:
            assert roll_it_back(bench, how).release == ""
            assert bench.texts[0].startswith("cannot rollback robot: inhibited by ")
            assert ("StopUnit", UNIT) in bench.manager.calls
            return
        with pytest.raises(DoraSystemdError) as caught:
            roll_it_back(bench, how)
    assert caught.value.message.startswith("cannot rollback robot: inhibited by ")
    assert bench.manager.calls == []


def test_what_is_disabled_and_stopped_runs_again_by_its_id(bench: Bench) -> None:
    """systemd knows nothing of it, and no unit file says what ran."""
    first, _ = bench.releases
    bench.manager.paths[1].unlink()
    bench.manager.units.clear()
    done = roll_back(bench.manager, bench.scope, "robot", first, 0, bench.steps.append)
    assert (done.release, done.former) == (first, "")
    assert bench.releases[first] == "current"


@pytest.mark.parametrize("act", [deploy_it, roll_it_back])
@pytest.mark.parametrize("may_wait", [False, True])
def test_a_node_that_waits_for_a_device(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Act, may_wait: bool
) -> None:
    """A fault, unless somebody has said that it may wait."""
    later = str(10**18)
    waits = life_record(
        *("node-waiting", 5, "robot"),
        scope=bench.scope,
        MESSAGE_ID=EVENTS["node-waiting"].message_id,
        DORA_NODE="a",
        DORA_REASON="/dev/cam (not there)",
        _SYSTEMD_INVOCATION_ID="77",
        _BOOT_ID=now_boot(),
        __MONOTONIC_TIMESTAMP=later,
    )
    FakeJournal(monkeypatch, tmp_path).write(waits)
    runs = next(one for one, state in bench.releases.items() if state == "current")
    if may_wait:
        assert act(bench, IfInhibited.REFUSE, True).former == runs
        return
    with pytest.raises(DoraSystemdError, match="node a: waits for /dev/cam") as caught:
        act(bench, IfInhibited.REFUSE, False)
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert bench.releases[runs] == "current"
