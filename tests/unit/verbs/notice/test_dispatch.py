"""When notices are sent: at once, then with pauses, and none is lost at the end of the service."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from dora_systemd.decisions.notice.happened import Happened, Sent, Story
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.tree import clear_directory
from dora_systemd.values import SECOND
from dora_systemd.verbs.notice.dispatch import Dispatcher
from tests.unit.fakes.manager import FakeManager, ScopeIn, options

UNIT = "dora-robot.service"
AGAIN = [("StartUnit", "doranotice@robot.service")]


class Bench:
    """A service with a clock that its sleeps move. failures: when the unit fails, in seconds."""

    def __init__(self, root: Path, failures: Sequence[float], last: Sent | None = None) -> None:
        self.manager, self.scope = FakeManager(), ScopeIn(is_user=False, uid=0, root=root)
        self.failures, self.last, self.now = failures, last, 0
        self.sent: list[tuple[float, int]] = []
        self.error: DoraSystemdError | None = None
        self.learned: list[float] = []
        self.manager.add(options())

    def run(self) -> list[tuple[float, int]]:
        """Run the service until it ends: when it has sent notices, and of how many failures."""
        given = (self.manager, self.scope, "robot", self.read, self.learn, self.send, self.sleep)
        Dispatcher(*given, lambda: self.now).run()
        return self.sent

    def read(self) -> Story:
        """What the journal has by now."""
        if self.error:
            raise self.error
        since = self.last.until_us if self.last else -1
        times = [int(one * SECOND) for one in self.failures]
        new = [Happened("failed", one, one) for one in times if since < one <= self.now]
        return new[::-1], self.last

    def learn(self) -> None:
        """Read the setting."""
        self.learned.append(self.now / SECOND)

    def send(self, happened: Sequence[Happened], pause_us: int) -> None:
        """Send, and record that."""
        self.sent.append((self.now / SECOND, len(happened)))
        self.last = Sent(self.now, happened[0].mono_us, pause_us)

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now += int(seconds * SECOND)
        if any(one * SECOND <= self.now for one in self.failures):
            self.manager.units[UNIT]["ActiveState"] = "failed"


def test_one_failure_is_one_notice(tmp_path: Path) -> None:
    bench = Bench(tmp_path, [0.0])
    assert bench.run() == [(1.0, 1)]
    assert bench.manager.calls == []


def test_nothing_has_happened(tmp_path: Path) -> None:
    assert Bench(tmp_path, []).run() == []


def test_a_storm_is_few_notices_that_count(tmp_path: Path) -> None:
    """100 failures in a minute; the service then ends."""
    sent = Bench(tmp_path, [one * 0.6 for one in range(100)]).run()
    assert [count for _, count in sent] == [2, 25, 50, 23]
    assert [moment for moment, _ in sent] == [1.0, 16.0, 46.0, 106.0]


def test_a_pause_that_a_former_process_began(tmp_path: Path) -> None:
    """In it the dataflow may be stopped."""
    bench = Bench(tmp_path, [0.0], Sent(-5 * SECOND, -5 * SECOND, 15 * SECOND))
    assert bench.run() == [(10.0, 1)]
    assert bench.learned[0] == 1.0


def test_a_failure_while_the_service_ends(tmp_path: Path) -> None:
    """systemd had dropped that start, because the service was still running."""
    bench = Bench(tmp_path, [0.0, 2.5])
    assert bench.run() == [(1.0, 1)]
    assert bench.manager.calls == AGAIN


def test_a_journal_that_cannot_be_read(tmp_path: Path) -> None:
    """There is a notice nevertheless, and four a minute at most."""
    bench = Bench(tmp_path, [])
    bench.error = DoraSystemdError("cannot read the journal")
    assert bench.run() == [(1.0, 1)]
    assert bench.now >= 15 * SECOND
    assert bench.manager.calls == []


def test_requests_are_removed_first(tmp_path: Path) -> None:
    bench = Bench(tmp_path, [])
    directory = bench.scope.notice_directory("robot")
    directory.mkdir(parents=True)
    (directory / "request").touch()
    bench.run()
    assert not list(directory.iterdir())


@pytest.mark.parametrize(("fails_at", "sent"), [(3.0, [4]), (60.0, [])])
def test_a_runner_that_ends_for_good(tmp_path: Path, fails_at: float, sent: list[int]) -> None:
    """Its unit fails when the service has removed the request: it is reported at once."""
    bench = Bench(tmp_path, [fails_at])
    directory = bench.scope.notice_directory("robot")
    directory.mkdir(parents=True)
    (directory / "last").touch()
    assert [int(moment) for moment, _ in bench.run()] == sent
    assert not list(directory.iterdir())
    assert bench.now < 20 * SECOND


def test_what_cannot_be_removed_does_not_start_it_for_ever(tmp_path: Path) -> None:
    bench = Bench(tmp_path, [])
    (bench.scope.notice_directory("robot") / "x").mkdir(parents=True)
    bench.run()
    assert bench.manager.calls == [("StopUnit", "doranotice@robot.path")]


@pytest.mark.parametrize("is_link", [False, True])
def test_links_are_not_followed(tmp_path: Path, is_link: bool) -> None:
    """Neither as the directory nor in it."""
    victim, directory = tmp_path / "victim", tmp_path / "requests"
    victim.mkdir()
    (victim / "file").touch()
    if is_link:
        directory.symlink_to(victim)
    else:
        directory.mkdir()
        (directory / "a").symlink_to(victim)
        (directory / "b").symlink_to(victim / "file")
        os.mkfifo(directory / "c")
    assert clear_directory(directory)
    assert (victim / "file").exists()
    assert is_link or not list(directory.iterdir())
