"""A dataflow in the foreground: its end, and what Ctrl+C does."""

import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.start import run
from dora_systemd.verbs.start.run import (
    attached_properties,
    follow_unit,
    life_line,
    require_executed,
)
from tests.unit.fakes.manager import FakeManager, options

UNIT = "dora-robot.service"


class Life(FakeManager):
    """A unit that goes through `states`, one at each look; `interrupts` Ctrl+C come at its start.

    Its file descriptor is a pipe, as poll(2) wants one.
    """

    def __init__(
        self,
        states: list[dict[str, Any]],
        interrupts: int = 0,
        number: signal.Signals = signal.SIGINT,
    ) -> None:
        super().__init__()
        self.number = number
        self.add(options())
        self.states = states
        self.interrupts = interrupts
        self.pipe = os.pipe()

    def fileno(self) -> int:
        return self.pipe[0]

    def changes(self, unit: str) -> list[Mapping[str, Any]]:
        if len(self.calls) < self.interrupts:
            threading.Timer(0.01, os.kill, (os.getpid(), self.number)).start()
        elif self.states:
            self.units[unit] |= self.states.pop(0)
        return [{"StatusText": "1/1 nodes running"}, {"NRestarts": 0}]


class Lines:
    """Log lines that never come; remembers whether they were read to the end."""

    def __init__(self) -> None:
        self.pipe = os.pipe()
        self.is_finished = False

    def fileno(self) -> int:
        return self.pipe[0]

    def print_new(self) -> None:
        assert not self.is_finished

    def finish(self) -> None:
        self.is_finished = True


@pytest.fixture
def logs() -> Iterator[Lines]:
    lines = Lines()
    yield lines
    for fd in lines.pipe:
        os.close(fd)


ENDED = {"ActiveState": "inactive"}
FAILED = {"ActiveState": "failed", "Result": "exit-code", "ExecMainStatus": 1}
KILLED = {"ActiveState": "failed", "Result": "signal", "ExecMainCode": 2, "ExecMainStatus": 9}
RESTARTING = {"ActiveState": "inactive", "Job": [7, "/job/7"]}


@pytest.mark.parametrize(
    ("states", "status"),
    [
        ([ENDED], 0),
        ([FAILED], 1),
        ([KILLED], 137),
        ([{**FAILED, "ExecMainStatus": 70}], 1),
        ([{**FAILED, "ExecMainStatus": 69}], 69),
        ([{**ENDED, "ExecMainCode": 1, "ExecMainStatus": 71}], 1),
        ([RESTARTING, {"Job": [0, "/"], "ActiveState": "active"}, ENDED], 0),
        ([{"ActiveState": "failed", "Result": "timeout"}], 1),
    ],
)
def test_exit_status(logs: Lines, states: list[dict[str, Any]], status: int) -> None:
    stages: list[str] = []
    assert follow_unit(Life(list(states)), UNIT, logs, stages.append) == status
    assert logs.is_finished
    assert set(stages) == {"1/1 nodes running"}


def test_a_runner_that_systemd_could_not_execute() -> None:
    scope = Scope(is_user=False, uid=0)
    for status in (0, 1, 69, 137):
        require_executed(scope, "robot", status)
    with pytest.raises(DoraSystemdError) as caught:
        require_executed(scope, "robot", 226)
    assert caught.value.message.startswith("cannot start robot: its sandbox could not be set up")
    assert caught.value.hint == "doractl --system why robot shows more"


def test_first_ctrl_c_stops_and_second_kills(logs: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_ONE_REQUEST_SECONDS", 0.0)
    before = signal.getsignal(signal.SIGINT)
    manager = Life([ENDED], interrupts=2)
    follow_unit(manager, UNIT, logs, None)
    assert manager.calls == [("StopUnit", UNIT), ("kill", UNIT, signal.SIGKILL, "all")]
    assert signal.getsignal(signal.SIGINT) is before


def test_timeout_signals_twice_and_means_one_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    manager.add(options())
    clock = iter([10.0, 10.001, 10.09, 10.5])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    stop = run._Stop(manager, UNIT)
    for _ in range(3):
        stop.ask()
    assert manager.calls == [("StopUnit", UNIT)]
    stop.ask()
    assert manager.calls[1:] == [("kill", UNIT, signal.SIGKILL, "all")]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_gracefully(logs: Lines, number: signal.Signals) -> None:
    manager = Life([ENDED], interrupts=1, number=number)
    assert follow_unit(manager, UNIT, logs, None) == 0
    assert manager.calls == [("StopUnit", UNIT)]


def test_another_signal_is_left_alone(logs: Lines) -> None:
    before = [signal.getsignal(one) for one in run.SIGNALS]
    during: list[Any] = []

    def look(_: str) -> None:
        during.extend(signal.getsignal(one) for one in run.SIGNALS)

    follow_unit(Life([ENDED]), UNIT, logs, look, (signal.SIGINT,))
    assert [now == then for now, then in zip(during, before, strict=False)] == [False, True]


@pytest.mark.parametrize(("after", "calls"), [(0, [("StopUnit", UNIT)]), (3600 * SECOND, [])])
def test_it_stops_after_a_time(logs: Lines, after: int, calls: list[Any]) -> None:
    manager, asked = Life([ENDED]), list[int]()
    on_stop = partial(asked.append, 1)
    assert follow_unit(manager, UNIT, logs, None, stop_after=after, on_stop=on_stop) == 0
    assert manager.calls == calls
    assert len(asked) == len(calls), "the journal says who has stopped it"


def test_the_life_line_is_closed_with_the_block() -> None:
    with life_line() as pipe:
        kept = os.dup(pipe)
        names = {name: value for name, _, value in attached_properties(pipe)}
        assert names["StandardInputFileDescriptor"] == pipe
        assert names["AddRef"] is True
    assert os.read(kept, 1) == b""
    os.close(kept)
