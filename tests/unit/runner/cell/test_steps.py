"""What each step of the pump is called when it cannot be done, and what the journal is told."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.states import Do, State
from tests.unit.fakes.loop import live
from tests.unit.runner.cell.test_pump import Bench


def refuse(*_: object) -> Any:
    raise OSError(11, "busy")


def spoil_event(bench: Bench) -> None:
    bench.pump.on_event = refuse


def spoil_table(bench: Bench) -> None:
    bench.pump.amend = refuse


def spoil_record(bench: Bench) -> None:
    bench.pipes.broken = {"node-crashed"}


@pytest.mark.parametrize(
    ("spoil", "step"),
    [
        (spoil_event, "notify other machines"),
        (spoil_table, "show its state"),
        (spoil_record, "write the event node-crashed"),
    ],
)
def test_a_step_that_raises_is_named(
    tmp_path: Path, spoil: Callable[[Bench], None], step: str
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        spoil(bench)
        bench.push(life.NodeExited(1, "a", exit_of(1), False))
        assert bench.pump.cell.state is State.ENDED
        assert bench.pump.cell.failure.startswith(f"the runner could not {step}: ")
        assert bench.pump.cell.cause is Cause.RUNNER_BROKEN
        assert await bench.pump.end is RunnerExit.FAILED

    live(work)


def test_a_condition_that_raises_is_named(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        wait = asyncio.create_task(
            bench.pump.wait(lambda cell: cell.notice == "x" and refuse(), None)
        )
        await asyncio.sleep(0)
        bench.push(life.ReloadNoted(1, "x"))
        wait.cancel()
        failure = "the runner could not notify its own tasks: "
        assert bench.pump.cell.failure == f"{failure}BlockingIOError: [Errno 11] busy"

    live(work)


def test_a_failure_that_cannot_be_handled_ends_the_cell_without_the_table(tmp_path: Path) -> None:
    async def work() -> None:
        broken: Any = None
        bench = Bench(tmp_path, State.RUNNING, failure="x", culprits=broken)
        done = bench.push(life.Failed(1, "take samples", "no"))
        assert bench.pump.cell.state is State.ENDED
        assert (Do.EXIT,) not in done
        assert await bench.pump.end is RunnerExit.FAILED

    live(work)


def test_the_journal_is_told_of_which_node(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.push(life.NodeExited(1, "a", exit_of(1), False), life.StopAsked(2, "SIGTERM"))
        assert bench.pipes.events[0] == ("node-crashed", "a", {"exit": "exit code 1"})
        name, node, details = bench.pipes.events[1]
        assert (name, node, details["by"]) == ("dataflow-stopping", None, "SIGTERM")

    live(work)


def test_others_see_each_event_before_it_changes_the_cell(tmp_path: Path) -> None:
    seen: list[tuple[str, str]] = []

    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)

        def note(event: life.Event) -> None:
            assert event.at_us > 0
            seen.append((type(event).__name__, bench.pump.cell.notice))

        bench.pump.on_event = note
        bench.push(life.ReloadNoted(1, "x"), life.ReloadNoted(2, "y"))
        assert seen == [("ReloadNoted", ""), ("ReloadNoted", "x")]

    live(work)


def test_the_loss_of_the_directory_has_a_time(tmp_path: Path) -> None:
    seen: list[life.Event] = []

    async def work() -> None:
        bench = Bench(tmp_path / "gone", State.RUNNING)
        bench.pump.on_event = seen.append
        await bench.pump.end
        assert seen[0].at_us > 0

    live(work)


def test_what_other_machines_say_is_in_the_table(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.pump.amend = lambda table: table._replace(text="of all machines")
        bench.pump.refresh()
        assert bench.table["text"] == "of all machines"
        assert bench.table["uuid"] == "uuid"
        assert bench.paths.status.stat().st_mode & 0o777 == 0o600

    live(work)


def test_samples_are_kept_one_after_another(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.pump.sample()
        bench.pump.sample()
        assert len(bench.table["samples"]) == 2

    live(work)


def test_who_has_waited_is_not_told_again(tmp_path: Path) -> None:
    asked: list[str] = []

    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)

        def is_x(cell: Any) -> bool:
            asked.append(cell.notice)
            return bool(cell.notice == "x")

        wait = asyncio.create_task(bench.pump.wait(is_x, None))
        await asyncio.sleep(0)
        bench.push(life.ReloadNoted(1, "w"), life.ReloadNoted(2, "x"), life.ReloadNoted(3, "y"))
        assert await wait
        bench.push(life.ReloadNoted(4, "z"))
        assert asked == ["", "w", "x"]

    live(work)


def test_who_waited_too_long_is_told_so(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        loop = asyncio.get_running_loop()
        begun = loop.time()
        assert not await bench.pump.wait(lambda cell: cell.notice == "x", 5)
        assert loop.time() - begun == 5

    live(work)


def test_an_event_that_changes_nothing_is_not_published(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        bench.paths.status.unlink()
        bench.push(life.CoordinatorListening(1))
        assert not bench.paths.status.exists()
        bench.pump.cell = replace(bench.pump.cell, notice="x")
        bench.push(life.ReloadNoted(1, "y"))
        assert bench.paths.status.exists()

    live(work)


def test_a_sample_has_the_time_of_the_clock_that_never_jumps(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.RUNNING)
        begun = time.monotonic_ns() // 1000
        bench.pump.sample()
        (sample,) = CellStatus.from_json(bench.paths.status.read_text()).samples
        assert begun <= sample.at_us <= time.monotonic_ns() // 1000

    live(work)
