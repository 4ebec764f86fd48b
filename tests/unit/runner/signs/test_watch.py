"""The watch over nodes, with a pump that notes events; time passes at once."""

from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path
from signal import SIGABRT, Signals
from typing import Any

import pytest

from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.decisions.signs.messages import parse_message
from dora_systemd.decisions.signs.table import Sign
from dora_systemd.paths import CellPaths
from dora_systemd.runner.signs.sockets import Signs
from dora_systemd.runner.signs.watch import SignWatch
from dora_systemd.values import SECOND
from tests.unit.fakes.dialogue import OPTIONS, Bench
from tests.unit.fakes.loop import live

LIMIT = 4 * SECOND


class Watched(Bench):
    """A node "a" with pid 7. now: CLOCK_MONOTONIC µs."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.now = SECOND
        self.signals: list[tuple[Signals, int]] = []
        self.kill_file = root / "node-a/cgroup.kill"
        self.kill_file.parent.mkdir()
        self.kill_file.touch()
        paths = CellPaths(root)
        paths.io.mkdir()
        tell = self.pipes.write_event
        signs = Signs({"a": LIMIT}, root, paths, tell, clock_us=lambda: self.now)
        signs.make("a")
        self.signs, self.nodes.signs, self.is_blocked = signs, signs, False
        options = OPTIONS._replace(grace=2 * SECOND)
        self.watch = SignWatch(signs, self.pump, lambda _: self.is_blocked, options, self.send)
        ((_, self.ear),) = signs.ears()

    def send(self, _group: Path, number: Signals, first: int) -> None:
        self.signals.append((number, first))

    @property
    def done(self) -> list[Any]:
        """The signals, and the name of the group if it was killed."""
        return [*self.signals, *["node-a"] * (self.kill_file.read_text() == "1")]

    def close(self) -> None:
        """Leave no socket."""
        self.signs.remove("a")

    def passes(self, seconds: float) -> None:
        """Let time pass, with a look each half second."""
        for _ in range(int(seconds * 2)):
            self.now += SECOND // 2
            self.watch._look()


def bench(tmp_path: Path) -> AbstractContextManager[Watched]:
    return closing(Watched(tmp_path))


def test_a_silent_node_is_ended_then_killed(tmp_path: Path) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.passes(1)
            one.ear.hear(parse_message(b"WATCHDOG=1\nSTATUS=up"), one.signs.clock)
            one.passes(3.5)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]
            reason, details = "no WATCHDOG=1 for 4s", {"status": "up"}
            assert one.heard == [life.NodeHung(0, "a", reason, "node-watchdog", details)]
            one.passes(10)
            assert one.done == [(SIGABRT, 7), "node-a"], "it has not ended by itself"

    live(work)


@pytest.mark.parametrize("state", [State.WAITING, State.STOPPING, State.CLOSING])
def test_only_a_running_dataflow_is_watched(tmp_path: Path, state: State) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.enter(state)
            one.passes(100)
            assert one.done == []

    live(work)


@pytest.mark.parametrize("state", ["restarting", "reloading", "finished", "failed", "ready"])
def test_only_a_running_node_is_watched(tmp_path: Path, state: str) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.pump.cell = replace(one.pump.cell, nodes={"a": NodeStatus(state, 7)})
            one.passes(100)
            assert one.done == []

    live(work)


def test_a_start_that_takes_too_long(tmp_path: Path) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.pump.cell = replace(one.pump.cell, nodes={"a": NodeStatus("starting", 7)})
            one.passes(90)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]
            (hung,) = one.heard
            assert isinstance(hung, life.NodeHung)
            assert hung.reason == "not ready within 1min 30s"

    live(work)


def test_a_node_that_waits_for_the_journal(tmp_path: Path) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.is_blocked = True
            one.passes(100)
            one.is_blocked = False
            one.passes(3.5)
            assert one.done == []
            one.passes(1)
            assert one.done == [(SIGABRT, 7)]

    live(work)


def test_it_asks_for_its_end_and_the_table_is_written(tmp_path: Path) -> None:
    async def work() -> None:
        with bench(tmp_path) as one:
            one.passes(1)
            one.ear.hear(parse_message(b"WATCHDOG=trigger\nSTATUS=bye"), one.signs.clock)
            one.watch._hear_news()
            one.watch._hear_news()
            one.watch._publish()
            assert one.done == [(SIGABRT, 7)]
            assert Sign("bye", 0, LIMIT) == one.signs.table()["a"]
            assert '"bye"' in CellPaths(tmp_path).status.read_text()
            one.watch._publish()
            assert one.done == [(SIGABRT, 7)], "once"

    live(work)
