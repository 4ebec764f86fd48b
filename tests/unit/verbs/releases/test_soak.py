"""How long a trial lasts: until all that nodes owe has come, however short the soak is."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.status import FAILED_BECAUSE
from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.logs.journal_events import EVENTS
from dora_systemd.decisions.logs.query import PROCESS_EXITED, UNIT_STARTING
from dora_systemd.decisions.releases.progress import Step, starting, stopping
from dora_systemd.decisions.why.trial_faults import Fault
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.lives import now_boot
from dora_systemd.verbs.releases.soak import LATE, Gate, settle
from tests.unit.fakes.journal import FakeJournal, life_record
from tests.unit.fakes.manager import UUID, FakeManager, options, with_owes

HUNG = "the supervisor process hung and was killed by the watchdog"
STOPPED = Fault("it was stopped", is_stop=True)
RESTARTED = Fault("it was restarted", is_outside=True)
IMAGE, DEPTH = Owed("camera", "image", SECOND, 3 * SECOND), Owed("camera", "depth", SECOND, SECOND)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, which only a sleep changes."""
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "monotonic_ns", lambda: int(now[0] * 1e9))
    monkeypatch.setattr(time, "sleep", lambda seconds: now.append(now.pop() + seconds))
    return now


def soaked(
    manager: FakeManager,
    scope: Scope,
    clock: list[float],
    comes: tuple[float, ...],
) -> tuple[Fault | None, list[Step]]:
    """What a trial of 2 s finds and tells, whose outputs come so many seconds after its begin."""
    runner = with_owes(options(), *(IMAGE, DEPTH)[: len(comes)])
    manager.add(runner, InvocationID=b"")
    told: list[Step] = []
    begun = clock[0]

    def heard(*_: object) -> tuple[int, ...]:
        last = 5 if clock[0] < begun else 0  # of what ran before
        return tuple(
            int((begun + one) * SECOND) if clock[0] >= begun + one else last for one in comes
        )

    return Gate(manager, scope, runner, told.append, heard)._soak(2 * SECOND), told


@pytest.mark.usefixtures("journal")
@pytest.mark.parametrize(
    ("comes", "seconds"), [((), 2), ((0.5,), 2), ((2.5,), 2.6), ((2.5, 0.1), 2.6)]
)
def test_it_lasts_until_all_has_come(
    manager: FakeManager,
    scope: Scope,
    clock: list[float],
    comes: tuple[float, ...],
    seconds: float,
) -> None:
    found, told = soaked(manager, scope, clock, comes)
    assert found is None
    assert clock[0] - 1000 == pytest.approx(seconds, abs=0.21)
    assert any("waits for camera/image" in one.text for one in told) == (seconds > 2)


@pytest.mark.usefixtures("journal")
def test_what_never_comes_fails_it(manager: FakeManager, scope: Scope, clock: list[float]) -> None:
    found, _ = soaked(manager, scope, clock, (1e6, 0.1))
    words = "node camera: silent, no image within 3s of its start"
    assert (found, clock[0] < 1006) == (Fault(words, "camera"), True)


@pytest.mark.usefixtures("journal")
@pytest.mark.parametrize(
    ("after", "facts", "fault"),
    [
        (0.5, {}, None),
        (0.5, {"InvocationID": b"\2", "NRestarts": 1}, Fault("systemd has restarted it")),
        (0.5, {"InvocationID": b"\2"}, RESTARTED),
        (5.0, {"InvocationID": b"\2"}, None),
        (0.5, {"ActiveState": "inactive"}, STOPPED),
        (0.5, {"ActiveState": "failed", "Result": "watchdog"}, Fault(HUNG)),
    ],
)
def test_what_becomes_of_the_unit_while_it_is_watched(
    scope: Scope,
    clock: list[float],
    after: float,
    facts: dict[str, object],
    fault: Fault | None,
) -> None:
    """With Restart=always a unit that fails is active again a moment later."""

    class Changing(FakeManager):
        def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
            self.units[unit] |= facts if clock[0] > 1000 + after else {}
            return super().read(unit, names)

    manager = Changing()
    manager.add(options(), InvocationID=b"\1")
    assert Gate(manager, scope, options(), lambda _: None)._soak(2 * SECOND) == fault


@pytest.mark.usefixtures("journal")
@pytest.mark.parametrize(
    ("then", "fault"),
    [
        ({"ActiveState": "inactive", "Job": (0, "/")}, STOPPED),
        ({"ActiveState": "activating", "InvocationID": b"\2"}, RESTARTED),
    ],
)
def test_a_stop_is_judged_when_it_is_over(
    scope: Scope, clock: list[float], then: dict[str, object], fault: Fault
) -> None:
    """Nodes may take their time: neither failed the release, and a stop stays one."""

    class Stopping(FakeManager):
        def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
            if clock[0] > 1000.5:
                self.units[unit] |= {"ActiveState": "deactivating", "Job": (1, "/")}
            self.units[unit] |= then if clock[0] > 1004 else {}
            return super().read(unit, names)

    manager = Stopping()
    manager.add(options(), InvocationID=b"\1")
    assert Gate(manager, scope, options(), lambda _: None)._soak(2 * SECOND) == fault


def crash(at: float, boot: str = "") -> dict[str, object]:
    """A record of journalctl; its CLOCK_REALTIME is that of a clock that was set back."""
    return life_record(
        *("node-crashed", 5),
        MESSAGE_ID=EVENTS["node-crashed"].message_id,
        DORA_NODE="camera",
        DORA_EXIT="exit code 1",
        _SYSTEMD_INVOCATION_ID="1",
        _BOOT_ID=boot or now_boot(),
        __MONOTONIC_TIMESTAMP=str(int(at * SECOND)),
    )


@pytest.fixture
def journal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeJournal:
    return FakeJournal(monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("record", "is_fault"), [(crash(1001), True), (crash(999), False), (crash(1001, "a"), False)]
)
def test_a_clock_that_is_set_back_hides_no_fault(
    manager: FakeManager,
    scope: Scope,
    clock: list[float],
    journal: FakeJournal,
    record: dict[str, object],
    is_fault: bool,
) -> None:
    assert clock == [1000]
    manager.add(options(), InvocationID=b"")
    journal.write(record)
    fault = Gate(manager, scope, options(), lambda _: None)._fault()
    assert fault == (Fault("node camera: exit code 1", "camera") if is_fault else None)


def test_a_crash_ends_the_wait_for_all_nodes(
    manager: FakeManager, scope: Scope, clock: list[float], journal: FakeJournal
) -> None:
    """dora may start a node again and again, without end."""
    unit = manager.add(options(), InvocationID=b"", ActiveState="activating", StatusText="")
    gate = Gate(manager, scope, options(), lambda _: None)
    journal.write(crash(1000.5))
    manager.units[unit]["Job"] = (1, "/")
    assert gate._wait_ready(120 * SECOND) == Fault("node camera: exit code 1", "camera")
    assert clock[0] < 1002


def record(event: str, **fields: str) -> dict[str, str]:
    return {**crash(1001), "DORA_EVENT": event, "DORA_NODE": "", "DORA_EXIT": "", **fields}


@pytest.mark.parametrize("may_wait", [False, True])
def test_a_node_may_wait_for_what_it_needs(
    manager: FakeManager,
    scope: Scope,
    clock: list[float],
    journal: FakeJournal,
    may_wait: bool,
) -> None:
    """Then nobody waits for what nodes owe; another fault is one in any case."""
    assert clock
    manager.add(with_owes(options(), IMAGE), InvocationID=b"")
    gate = Gate(
        *(manager, scope, with_owes(options(), IMAGE), lambda _: None, lambda *_: (0,)),
        may_wait=may_wait,
    )
    waits = record("node-waiting", DORA_NODE="camera", DORA_REASON="/dev/cam (not there)")
    journal.write(waits)
    found = gate._soak(2 * SECOND)
    waiting = Fault("node camera: waits for /dev/cam (not there)", "camera")
    assert found and found[:2] == waiting[:2] if not may_wait else found is None
    journal.write(crash(1002))
    assert (gate._fault() == CRASHED) or not may_wait


WORDS = f"{FAILED_BECAUSE}node camera: exit code 1 after 2 restarts"
CRASHED = Fault("node camera: exit code 1", "camera")
REFUSED = {"StatusText": "failed: cannot use x: y; hint: z", "ExecMainStatus": 72}


@pytest.mark.parametrize(
    ("records", "facts", "fault"),
    [
        ([], {}, STOPPED),
        ([record("dataflow-finished")], {}, None),
        ([record("dataflow-stopped")], {}, STOPPED),
        ([record("dataflow-stopped"), record("dataflow-finished")], {}, STOPPED),
        ([crash(1001)], {"StatusText": WORDS}, Fault(WORDS[len(FAILED_BECAUSE) :], "camera")),
        ([crash(1001)], {"StatusText": f"{WORDS}, node b: signal SIGKILL"}, CRASHED),
        ([crash(1001)], {"StatusText": WORDS.replace("camera", "plot")}, CRASHED),
        ([], REFUSED, Fault("cannot use x: y")),
        ([], {"ActiveState": "failed", **REFUSED}, Fault("cannot use x: y")),
        ([], {"ActiveState": "failed", "Result": "watchdog"}, Fault(HUNG)),
        ([], {"SubState": "auto-restart", "ActiveState": "activating"}, Fault("exit code 0")),
    ],
)
def test_what_its_end_means(
    manager: FakeManager,
    scope: Scope,
    clock: list[float],
    journal: FakeJournal,
    records: list[dict[str, str]],
    facts: dict[str, object],
    fault: Fault | None,
) -> None:
    assert clock
    unit = manager.add(options(), "inactive", InvocationID=b"")
    gate = Gate(manager, scope, options(), lambda _: None)
    manager.units[unit] |= facts
    journal.write(*records)
    assert gate._wait_ready(SECOND) == fault


def of_systemd(message: str, at: float) -> dict[str, object]:
    """A record of systemd about the life of the trial."""
    own = {"UNIT": "dora-robot.service", "_PID": "1", "INVOCATION_ID": "1"}
    known = {**crash(at), "DORA_NODE": "", "MESSAGE_ID": message, **own}
    return {key: value for key, value in known.items() if key != "DORA_EVENT"}


@pytest.mark.parametrize("asked_at", [1001.5, 1002.5, 0])
def test_a_requested_kill_is_a_stop(
    manager: FakeManager, scope: Scope, clock: list[float], journal: FakeJournal, asked_at: float
) -> None:
    assert clock
    manager.add(options(), "failed", InvocationID=b"")
    gate = Gate(manager, scope, options(), lambda _: None)
    known = {"DORA_DATAFLOW": UUID, "DORA_DATAFLOW_NAME": "robot"}
    asked = record("stop-asked", MESSAGE_ID="x", _UID="0", **known)
    end = record("dataflow-failed", DORA_REASON=BY_SIGKILL, **known)
    journal.write(
        end,
        *([asked] if asked_at > 1002 else []),
        of_systemd(PROCESS_EXITED, 1002),
        *([asked] if 0 < asked_at < 1002 else []),
        of_systemd(UNIT_STARTING, 1001),
        asked,
    )
    found = gate._wait_ready(SECOND)
    assert found == (STOPPED if asked_at == 1001.5 else Fault(BY_SIGKILL))


def test_what_is_told_until_it_is_ready(scope: Scope, clock: list[float]) -> None:
    """First what runs now stops, and the status text of a unit that is down is an old one."""
    lives = [
        ("active", "0 nodes"),
        ("deactivating", "stopping, a left"),
        ("inactive", "old"),
        ("activating", "1/3 nodes ready"),
    ]

    class Changing(FakeManager):
        def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
            if "StatusText" in names:
                active, status = lives.pop(0) if lives else ("active", "3/3 nodes running")
                self.units[unit] |= {"ActiveState": active, "StatusText": status}
                self.units[unit]["Job"] = (1 if lives or active != "active" else 0, "/")
            return super().read(unit, names)

    manager, told = Changing(), list[Step]()
    manager.add(options(), InvocationID=b"")
    expected = [*map(stopping, (lives[0][1], lives[1][1])), starting(""), starting(lives[3][1])]
    assert Gate(manager, scope, options(), told.append)._wait_ready(120 * SECOND) is None
    assert told == expected
    assert clock[0] == pytest.approx(1000.8)


def test_what_ran_before_has_its_own_time_to_stop(clock: list[float]) -> None:
    """A recorder may need longer than the new version may take to be ready."""

    class Changing(FakeManager):
        def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
            states = {1250: "deactivating", 1252: "activating"}
            found = [state for until, state in states.items() if clock[0] < until]
            self.units[unit]["ActiveState"] = [*found, "active"][0]
            return super().read(unit, names)

    manager = Changing()
    manager.add(options(), InvocationID=b"\1")
    assert settle(manager, "dora-robot.service", 3 * SECOND, lambda *_: None) == "active"
    clock[0] = 1000.0
    assert settle(manager, "dora-robot.service", 1 * SECOND, lambda *_: None) == LATE


def test_what_ran_before_may_still_write_about_its_end(
    manager: FakeManager, scope: Scope, clock: list[float], journal: FakeJournal
) -> None:
    """A node that crashes when its dataflow is stopped is no fault of the next release."""
    assert clock
    unit = manager.add(options(), InvocationID=b"\x01")
    gate = Gate(manager, scope, options(), lambda _: None)
    journal.write({**crash(1001), "_SYSTEMD_INVOCATION_ID": "01"})
    assert gate._soak(0) is None
    manager.units[unit] |= {"ActiveState": "inactive", "InvocationID": b"\x02"}
    assert gate._wait_ready(SECOND) == STOPPED
    journal.write(crash(1001))
    assert gate._wait_ready(SECOND) == CRASHED


def test_nodes_that_are_not_ready_in_time(
    manager: FakeManager, scope: Scope, clock: list[float], journal: FakeJournal
) -> None:
    manager.add(options(), "activating", InvocationID=b"", StatusText="0/3 nodes ready")
    gate = Gate(manager, scope, options(), lambda _: None)
    late = Fault("not all nodes are ready after 3s")
    assert gate._wait_ready(3 * SECOND) == late
    assert clock[0] == pytest.approx(1003.1, abs=0.2)
    assert 4 <= len(journal.asked) <= 5, "it looks once in a second, and at the end"
