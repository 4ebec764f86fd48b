"""The first life of a unit, the delay before a restart, and the budget."""

import asyncio
import os
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dora_systemd.adapters.host import fd_store
from dora_systemd.decisions.cell.black_box import AFTER_BOOT, parse_black_box
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.restarts import HEAD_START, RestartPolicy
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.paths import CellPaths
from dora_systemd.runner.cell.restarts import (
    Life,
    age,
    asked,
    began_us,
    begin_hold,
    begin_life,
    find_spent,
    forget_restarts,
    held_until,
    is_first_life,
    is_transient,
    learn_first,
    no_hold,
    pause,
    report_last_life,
    show,
)
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.loop import live
from tests.unit.fakes.manager import options, with_restart
from tests.unit.fakes.programs import make_program

DELAY = SECOND // 2
POLICY = RestartPolicy("always", 1000, 600 * SECOND, DELAY, 30 * SECOND)


class Unit:
    """A unit that is restarted: systemd's store of descriptors, NRestarts=, and who sleeps.

    old: seconds since systemd began the process.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.paths, self.slept, self.old = CellPaths(root), 0.0, 0.0
        self.monkeypatch = monkeypatch
        self.times: list[int] = []
        self.server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.server.bind(str(root / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(root / "notify"))
        monkeypatch.setenv("LISTEN_PID", str(os.getpid()))
        monkeypatch.setattr(time, "sleep", self.sleep)
        # The clock stands: what a busy machine takes for these steps is no part of a delay.
        now = time.clock_gettime(time.CLOCK_MONOTONIC)
        monkeypatch.setattr(time, "clock_gettime", lambda _: now)
        self.end(1000)
        library = SimpleNamespace(notify=lambda _: None)
        monkeypatch.setitem(sys.modules, "systemd", SimpleNamespace(daemon=library))
        monkeypatch.setitem(sys.modules, "systemd.daemon", library)
        self.store: Counter[str] = Counter({"dora-log-a": 2})
        make_program(
            root / "systemctl",
            f'echo "$@" >>{root}/asked\ncase "$*" in *NRestarts*) cat {root}/restarts\n'
            f";; *) cat {root}/ended; esac",
        )
        (root / "asked").touch()
        monkeypatch.setenv("PATH", f"{root}:{os.environ['PATH']}")

    def sleep(self, seconds: float) -> None:
        self.slept += seconds

    def end(self, seconds: float) -> None:
        """The last life that was active has ended so long ago."""
        ended = time.clock_gettime(time.CLOCK_MONOTONIC) - seconds
        (self.paths.root / "ended").write_text(f"{round(ended * SECOND)}\n")

    @property
    def asked(self) -> str:
        """What systemctl was asked so far."""
        return (self.paths.root / "asked").read_text()

    def keep_store(self) -> None:
        while True:
            try:
                text, fds, _, _ = socket.recv_fds(self.server, 1000, 2)
            except BlockingIOError:
                return
            lines = dict(line.split("=", 1) for line in text.decode().splitlines())
            if "FDSTOREREMOVE" in lines:
                del self.store[lines["FDNAME"]]
            else:
                self.store[lines["FDNAME"]] += len(fds)
            if lines.get("FDNAME") == fd_store.LIFE and fds:
                self.times.append(int(os.pread(fds[0], 32, 0)))
            for fd in fds:
                os.close(fd)

    def start(self, restarts: int, policy: RestartPolicy = POLICY) -> float:
        """One life begins: how long its nodes wait after systemd's own delay."""
        self.monkeypatch.setenv("LISTEN_FDNAMES", ":".join(self.store.elements()))
        (self.paths.root / "restarts").write_text(f"{restarts}\n")
        self.slept = 0.0
        pause(self.options(policy), self.paths)
        if fd_store.lives():
            old, is_user = self.old + self.slept, self.paths.is_of_user
            until = held_until(self.options(policy), is_user, old)
            left = until - time.clock_gettime(time.CLOCK_MONOTONIC)
            self.slept += max(round(left, 9), 0)
        self.keep_store()
        return self.slept

    def options(self, policy: RestartPolicy) -> RunnerOptions:
        return with_restart(options(uuid="uuid"), policy)


@pytest.fixture
def unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Unit]:
    unit = Unit(tmp_path, monkeypatch)
    yield unit
    unit.server.close()


def test_it_doubles_up_to_the_longest(unit: Unit) -> None:
    assert POLICY.unit_delay / SECOND == 0.1
    pauses = [round(0.1 + unit.start(restarts), 6) for restarts in range(9)]
    assert pauses == [0.1, 0.5, 1, 2, 4, 8, 16, 30, 30]


@pytest.mark.parametrize(("delay", "pauses"), [(0, [0, 0, 0]), (SECOND // 5, [0, 0.2, 0.4])])
def test_a_delay_shorter_than_the_head_start(unit: Unit, delay: int, pauses: list[float]) -> None:
    """systemd waits for nothing, and the runner for what its own start has not taken."""
    policy = POLICY._replace(delay=delay)
    assert policy.unit_delay == 0
    assert [round(unit.start(restarts, policy), 2) for restarts in range(3)] == pauses


def spent(unit: Unit, ages: list[int], restarts: int, policy: RestartPolicy) -> str:
    """Why the restart after lives that began so many seconds ago is refused, or ""."""
    now = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000
    with ExitStack() as stack:
        fds = [os.memfd_create(fd_store.LIFE) for _ in ages]
        for fd, seconds in zip(fds, ages, strict=True):
            stack.callback(os.close, fd)
            os.write(fd, str(now - seconds * SECOND).encode())
        names = [fd_store.LIFE if fd in fds else "other" for fd in range(3, max(fds) + 1)]
        unit.monkeypatch.setenv("LISTEN_FDNAMES", ":".join(names))
        (unit.paths.root / "restarts").write_text(f"{restarts}\n")
        error = find_spent(unit.options(policy), unit.paths)
    return error.message if error else ""


THREE = POLICY._replace(max_restarts=3)


@pytest.mark.parametrize(
    ("ages", "restarts", "policy", "is_spent"),
    [
        ([4, 3, 2], 3, THREE, False),
        ([5, 4, 3, 2], 4, THREE, True),
        # systemctl reset-failed, or a start by hand, while the store was kept
        ([5, 4, 3, 2], 0, THREE, False),
        ([6, 5, 4, 3, 2], 3, THREE, False),
        # The window of the first ones is over.
        ([700, 4, 3, 2], 4, THREE, False),
        ([700, 5, 4, 3, 2], 5, THREE, True),
        ([5, 4, 3, 2], 4, THREE._replace(policy="no"), False),
        ([5, 4, 3, 2], 4, THREE._replace(max_restarts=INFINITY), False),
    ],
)
def test_a_restart_beyond_the_budget_is_refused(
    unit: Unit, ages: list[int], restarts: int, policy: RestartPolicy, is_spent: bool
) -> None:
    words = "3 automatic restarts within 10min did not help"
    assert spent(unit, ages, restarts, policy) == (words if is_spent else "")


def test_each_life_says_when_it_began(unit: Unit) -> None:
    before = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000
    unit.start(0)
    asyncio.run(forget_restarts(unit.options(POLICY._replace(window=1))))
    unit.keep_store()
    first, after_window = unit.times
    assert before <= first <= time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000
    assert after_window >= first - 1


def test_a_quiet_window_is_forgotten(unit: Unit) -> None:
    for restarts in range(8):
        unit.start(restarts)

    async def wait() -> None:
        await forget_restarts(unit.options(POLICY._replace(window=1)))

    asyncio.run(wait())
    unit.keep_store()
    assert [unit.start(restarts) for restarts in (8, 9)] == [0.4, 0.9]


def test_what_is_reset_or_restarted_by_hand_is_forgotten(unit: Unit) -> None:
    for restarts in range(8):
        unit.start(restarts)
    assert [unit.start(restarts) for restarts in (0, 1, 2)] == [0.4, 0.4, 0.9]
    assert "show --value --property=NRestarts dora-robot.service\n" in unit.asked


def test_a_requested_stop_is_no_life_to_wait_after(unit: Unit) -> None:
    for restarts in range(5):
        unit.start(restarts)
    fd_store.forget_lives()
    unit.keep_store()
    assert unit.start(5) == 0


def test_only_what_is_left_of_the_delay_is_waited_for(unit: Unit) -> None:
    unit.start(0)
    unit.old = 0.5
    assert unit.start(1) == 0
    assert not unit.asked
    unit.old = 0.25
    assert unit.start(0) == pytest.approx(0.15)


@pytest.mark.parametrize(("since", "left"), [(0.42, 0.08), (0.1, 0.15), (0.9, 0), (60, 0.15)])
def test_the_delay_begins_when_the_last_life_has_ended(
    unit: Unit, since: float, left: float
) -> None:
    """systemd was late, or ExecStopPost= took its time; but 60 s ago was another life."""
    unit.start(0)
    unit.old = 0.25
    unit.end(since)
    assert unit.start(0) == pytest.approx(left, abs=1e-5)


def test_the_age_of_a_process() -> None:
    code = "import time; from dora_systemd.runner.cell.restarts import age; print(age())"
    began = time.monotonic()
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    assert -0.02 < float(printed) < time.monotonic() - began + 0.02


def test_it_is_seen(unit: Unit) -> None:
    for restarts in range(5):
        unit.start(restarts)
    status = CellStatus.from_json(unit.paths.status.read_text())
    assert (status.stage, status.text) == ("restarting", "restarting in 4s")
    assert status.started_us > time.time_ns() // 1000


def test_nothing_restarts(unit: Unit) -> None:
    assert [unit.start(n, POLICY._replace(policy="no")) for n in range(5)] == [0] * 5
    assert "dora-life" not in unit.store


@pytest.mark.parametrize(
    ("words", "environment", "is_requested"),
    [
        (("/bin/tell",), {"LISTEN_FDNAMES": "dora-life"}, True),
        (("/bin/tell",), {}, False),
        (("/bin/tell",), {"LISTEN_FDNAMES": "dora-life", "FDSTORE": "4096"}, False),
        ((), {"LISTEN_FDNAMES": "dora-life"}, False),
    ],
)
def test_an_old_systemd_sends_no_notice_of_a_life_that_is_restarted(
    tmp_path: Path, words: tuple[str, ...], environment: dict[str, str], is_requested: bool
) -> None:
    """The next life requests it."""
    directory = tmp_path / "dora-systemd-notice/robot"
    directory.mkdir(parents=True)
    given = {"RUNTIME_DIRECTORY": f"/run/dora-systemd/robot:{directory}", **environment}
    runner = options().with_value("on_failure", words)
    report_last_life(runner, given)
    assert list(directory.iterdir()) == [directory / "request"] * is_requested


@pytest.mark.parametrize(
    ("box", "fdnames", "is_requested"),
    [("yes", "", True), ("yes", "dora-life", False), ("no", "", False)],
)
def test_after_a_boot_the_service_looks_for_a_power_cut(
    tmp_path: Path, box: str, fdnames: str, is_requested: bool
) -> None:
    directory = tmp_path / "dora-systemd-notice/robot"
    directory.mkdir(parents=True)
    given = {"RUNTIME_DIRECTORY": f"/run/x/robot:{directory}", "FDSTORE": "4096"}
    given |= {"LISTEN_FDNAMES": fdnames} if fdnames else {}
    runner = options().with_value("black_box", parse_black_box(box))
    report_last_life(runner, given)
    is_new = time.clock_gettime(time.CLOCK_BOOTTIME) * SECOND < AFTER_BOOT
    assert list(directory.iterdir()) == [directory / "request"] * (is_requested and is_new)


def test_the_store_does_not_fill(unit: Unit) -> None:
    for restarts in range(100):
        unit.start(restarts)
    assert unit.store["dora-life"] == 64
    assert unit.store["dora-log-a"] == 2


def test_systemd_does_not_answer(unit: Unit) -> None:
    make_program(unit.paths.root / "systemctl", "exit 1")
    assert asked("NRestarts", "robot", True, 7) == 7


def test_without_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LISTEN_PID", raising=False)
    assert fd_store.lives() == 0
    given: dict[str, Any] = {"LISTEN_PID": "1", "LISTEN_FDNAMES": "dora-life"}
    for key, value in given.items():
        monkeypatch.setenv(key, value)
    assert fd_store.lives() == 0


def test_a_table_that_cannot_be_written_makes_no_delay_shorter(unit: Unit) -> None:
    unit.paths.status.mkdir()
    pauses = [round(0.1 + unit.start(restarts), 6) for restarts in range(5)]
    assert pauses == [0.1, 0.5, 1, 2, 4]


def test_systemd_is_asked_when_the_last_life_has_ended(unit: Unit) -> None:
    unit.start(0)
    unit.old = 0.25
    unit.start(0)
    last = unit.asked.splitlines()[-1]
    assert last == "show --value --property=ActiveExitTimestampMonotonic dora-robot.service"


def test_the_nodes_of_a_restart_are_held_back(unit: Unit) -> None:
    assert begin_hold(unit.options(POLICY), False) is no_hold
    assert begin_life(unit.options(POLICY), False).hold is no_hold
    unit.start(0)
    unit.monkeypatch.setenv("LISTEN_FDNAMES", fd_store.LIFE)
    unit.end(0.45)
    hold = begin_life(unit.options(POLICY), False).hold
    unit.monkeypatch.delenv("LISTEN_FDNAMES")  # what comes after it forgets them
    slept: list[float] = []

    async def note(seconds: float) -> None:
        slept.append(seconds)

    unit.monkeypatch.setattr(asyncio, "sleep", note)
    asyncio.run(hold())
    asyncio.run(no_hold())
    (seconds,) = slept
    assert 0 <= seconds <= 0.05


def test_a_process_that_is_as_old_as_the_delay_asks_nobody(unit: Unit) -> None:
    unit.start(0)
    unit.old = HEAD_START / SECOND
    assert unit.start(0) == 0
    assert not unit.asked


def test_the_age_of_this_process() -> None:
    command = ["ps", "-o", "etimes=", "-p", str(os.getpid())]
    seconds = int(subprocess.run(command, capture_output=True, check=True).stdout)
    assert abs(age() - seconds) < 2


def test_what_is_seen_while_a_restart_waits(unit: Unit) -> None:
    """In whole seconds, and never less than it takes."""
    begun = time.time_ns() // 1000
    show("uuid", unit.paths, 0.2)
    status = CellStatus.from_json(unit.paths.status.read_text())
    assert (status.uuid, status.stage, status.text) == ("uuid", "restarting", "restarting in 1s")
    assert 0.2 * SECOND <= status.started_us - begun < 20 * SECOND
    assert unit.paths.status.stat().st_mode & 0o777 == 0o600
    show("uuid", unit.paths, 2.0)
    assert CellStatus.from_json(unit.paths.status.read_text()).text == "restarting in 2s"
    show("uuid", unit.paths, 61.000001)
    text = CellStatus.from_json(unit.paths.status.read_text()).text
    assert text == "restarting in 1min 2s"


@pytest.mark.parametrize(
    "policy", [RestartPolicy("no", window=1), POLICY._replace(window=INFINITY)]
)
def test_what_never_restarts_or_never_forgets_does_not_wait(
    unit: Unit, policy: RestartPolicy
) -> None:
    unit.start(0)
    counted = unit.store["dora-life"]

    async def work() -> None:
        begun = asyncio.get_running_loop().time()
        await forget_restarts(unit.options(policy))
        assert asyncio.get_running_loop().time() == begun

    live(work)
    unit.keep_store()
    assert unit.store["dora-life"] == counted


ON_FAILURE = RestartPolicy("on-failure", delay=2 * SECOND)


@pytest.fixture
def unit_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That of a transient unit that starts right now, for the first time."""
    monkeypatch.setenv("FDSTORE", "4096")
    monkeypatch.delenv("LISTEN_FDNAMES", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = tmp_path / "systemd/transient/dora-robot.service"
    path.parent.mkdir(parents=True)
    path.touch()
    os.utime(path, (began_us() / SECOND - 0.1,) * 2)
    return path


@pytest.mark.usefixtures("unit_file")
def test_a_start() -> None:
    assert is_first_life(ON_FAILURE, "robot", is_user=True)
    assert not is_first_life(ON_FAILURE, "other", is_user=True)


@pytest.mark.parametrize("seconds", [-ON_FAILURE.unit_delay / SECOND, 60])
def test_a_life_may_have_been_before(unit_file: Path, seconds: float) -> None:
    """Or the clock was set."""
    os.utime(unit_file, (unit_file.stat().st_mtime + seconds,) * 2)
    assert not is_first_life(ON_FAILURE, "robot", is_user=True)
    assert is_first_life(RestartPolicy("no"), "robot", is_user=True)


@pytest.mark.usefixtures("unit_file")
def test_a_life_was_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    assert not is_first_life(ON_FAILURE, "robot", is_user=True)


Learn = Callable[[str, int], tuple[bool, list[str]]]
ASKED = ["--user show --value --property=NRestarts dora-enabled.service"]


@pytest.fixture
def learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Learn:
    """Whether a life knows in the end that it is the first one, and what it has asked systemctl."""
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    asked = tmp_path / "asked"

    def learn(name: str, restarts: int) -> tuple[bool, list[str]]:
        asked.write_text("")
        make_program(tmp_path / "systemctl", f'echo "$@" >> {asked}; echo {restarts}')
        begun = begin_life(with_restart(options(name), ON_FAILURE), is_user=True)
        asyncio.run(learn_first(begun, name, is_user=True, seconds=0.0))
        return begun.is_first, asked.read_text().splitlines()

    return learn


@pytest.mark.usefixtures("unit_file")
def test_systemd_is_asked_once_for_what_only_it_knows(
    learned: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert learned("robot", 0) == (True, [])
    assert learned("enabled", 0) == (True, ASKED)
    assert learned("enabled", 1) == (False, ASKED)
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    assert learned("enabled", 0) == (False, [])


@pytest.mark.usefixtures("unit_file")
def test_no_thread_is_left_to_ask(learned: Learn, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_thread: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert learned("enabled", 0) == (False, [])


@pytest.mark.parametrize(
    ("after", "is_first"),
    [
        (-ON_FAILURE.unit_delay / SECOND + 0.05, True),
        (-ON_FAILURE.unit_delay / SECOND - 0.05, False),
        (-0.02, True),
        (0.05, False),
    ],
)
def test_only_a_start_that_was_just_queued_is_the_first(
    unit_file: Path, after: float, is_first: bool
) -> None:
    """systemd writes the file then, before the process begins; a restart comes after its delay."""
    os.utime(unit_file, (began_us() / SECOND + after,) * 2)
    assert is_first_life(ON_FAILURE, "robot", is_user=True) == is_first


def test_a_life(monkeypatch: pytest.MonkeyPatch, unit_file: Path) -> None:
    begun = begin_life(with_restart(options("robot"), ON_FAILURE), is_user=True)
    assert (begun.uuid, begun.is_first, begun.may_be_first) == (options().uuid, True, False)
    assert begun.up_us == 0
    begun.become_up()
    first = begun.up_us
    assert 0 < first <= time.monotonic_ns() // 1000
    begun.become_up()
    assert begun.up_us == first
    unit_file.unlink()
    later = begin_life(with_restart(options("robot"), ON_FAILURE), is_user=True)
    assert (later.is_first, later.may_be_first) == (False, True), "systemd knows"
    monkeypatch.setenv("LISTEN_FDNAMES", "dora-life")
    later = begin_life(with_restart(options("robot"), ON_FAILURE), is_user=True)
    assert (later.is_first, later.may_be_first) == (False, False)
    plain = Life("uuid")
    assert (plain.is_first, plain.may_be_first) == (False, False)


def test_whose_unit_is_transient(unit_file: Path) -> None:
    assert is_transient("robot", is_user=True)
    assert not is_transient("other", is_user=True)
    assert not is_transient("robot", is_user=False), "root's are in /run"
    unit_file.unlink()
    assert not is_transient("robot", is_user=True)
