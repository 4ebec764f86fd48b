"""Reloads from the save of a file to what the operator is told about it."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.dora.preparation import prepare
from dora_systemd.decisions.life.states import State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.settings_file import SettingsFile
from tests.unit.fakes.loop import within
from tests.unit.fakes.reload import ReloadBench


class Bench(ReloadBench):
    """A reloader of a dataflow of the nodes a and b, which runs."""

    def __init__(self, root: Path, state: State = State.RUNNING) -> None:
        super().__init__(root, state)
        self.prepared = self.write("ab")
        settings = SettingsFile(str(root / "flow.systemd.yml"), root / "settings.yml")
        self.reloader = Reloader(self.options, {}, settings)

    def begin(self) -> None:
        self.reloader.begin(self.run, prepare(self.options, {}), 0)

    def see(self, *names: str) -> None:
        """What the watch of files does when these are saved."""
        self.reloader._changed |= {str(self.root / name) for name in names}
        self.reloader._wake.set()

    async def by_hand(self, node: str = "") -> Any:
        return (await self.reloader.answer({"verb": "reload", "node": node}))["done"]

    @property
    def reloaded(self) -> list[str]:
        return [node for method, node in self.asked if method == "ReplaceNode"]


async def until(is_so: Callable[[], object]) -> None:
    while not is_so():
        await asyncio.sleep(0.001)


def live(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(within(20, work()))


def test_a_save_while_a_reload_is_under_way_is_not_lost(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        bench.dora.then["ReplaceNode"] = lambda: None  # a is not ready yet
        task = asyncio.create_task(bench.reloader.work())
        bench.see("a.py")
        await until(lambda: bench.reloaded == ["a"])
        bench.see("b.py")
        await asyncio.sleep(0)
        assert bench.reloaded == ["a"], "one after the other"
        bench.dora.then["ReplaceNode"] = bench.spawn
        bench.spawn()
        await until(lambda: bench.reloaded == ["a", "b"])
        await until(lambda: len(bench.pipes.reasons("node-reloaded")) == 2)
        task.cancel()

    live(work)


def test_two_reloads_by_hand_follow_each_other(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        bench.dora.then["ReplaceNode"] = lambda: None
        first, second = (asyncio.create_task(bench.by_hand(node)) for node in "ab")
        await until(lambda: bench.reloaded)
        for _ in range(20):
            await asyncio.sleep(0.001)
        assert bench.reloaded == ["a"]
        bench.dora.then["ReplaceNode"] = bench.spawn
        bench.spawn()
        await asyncio.gather(first, second)
        assert bench.reloaded == ["a", "b"]

    live(work)


def test_a_save_between_two_runs_waits_for_the_next_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        task = asyncio.create_task(bench.reloader.work())
        bench.see("a.py")
        await asyncio.sleep(0.01)
        assert not bench.asked
        bench.begin()
        await until(lambda: bench.reloaded == ["a"])
        task.cancel()

    live(work)


def test_what_cannot_be_used_leaves_the_old_one_running(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        before = bench.reloader.current
        (tmp_path / "a.py").write_text("def broken(:\n")
        with pytest.raises(DoraSystemdError, match=r"cannot use .*a\.py: ") as caught:
            await bench.by_hand()
        assert caught.value.code is ExitCode.BAD_INPUT
        assert not bench.asked
        assert bench.reloader.current is before
        assert bench.states() == {"a": "running", "b": "running"}
        assert bench.pipes.reasons("reload-failed") == [caught.value.message]
        assert bench.pump.cell.notice.startswith(f"not reloaded: {tmp_path}/a.py: ")

    live(work)


def test_a_later_save_takes_the_notice_away(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        (tmp_path / "a.py").write_text("def broken(:\n")
        with pytest.raises(DoraSystemdError):
            await bench.by_hand()
        (tmp_path / "a.py").write_text("print()\n")
        (done,) = [one for one in await bench.by_hand() if "node a" in one]
        assert done.startswith("the node a was reloaded: a.py, ready after ")
        assert bench.pump.cell.notice == bench.reloader.notice == ""

    live(work)


def test_by_hand_while_nothing_runs(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        with pytest.raises(DoraSystemdError, match=r"^cannot reload: no node runs$") as caught:
            await bench.by_hand("a")
        assert caught.value.code is ExitCode.NOT_RUNNING
        bench.begin()
        bench.reloader.end()
        with pytest.raises(DoraSystemdError, match=r"^cannot reload: no node runs$"):
            await bench.by_hand("a")
        assert not bench.asked

    live(work)


def test_one_node_by_hand_whatever_has_changed(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        await bench.by_hand("b")
        assert bench.reloaded == ["b"]

    live(work)


def test_a_descriptor_whose_node_does_not_start_gives_way_to_the_old_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        before = bench.reloader.current
        bench.dora.then["AddNode"] = bench.crash
        bench.write("abc")
        with pytest.raises(DoraSystemdError, match="the previous version is running again"):
            await bench.reloader._reload([str(bench.flow)])
        assert bench.asked == [("AddNode", "c"), ("RemoveNode", "c")]
        assert bench.reloader.current is before

    live(work)


def test_what_dora_does_not_take_back_starts_again_as_a_whole(tmp_path: Path) -> None:
    """It starts no node again that has failed for good."""

    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        before = bench.reloader.current
        bench.dora.then["AddNode"] = bench.crash
        bench.dora.refuses["RemoveNode"] = "no running node `c`"
        bench.write("abc")
        task = asyncio.create_task(bench.reloader._reload([str(bench.flow)]))
        await until(lambda: bench.pump.cell.reload)
        assert bench.reloader.current is before
        assert bench.reloader.before is None
        bench.reloader.has_started()
        with pytest.raises(DoraSystemdError, match="the previous version is running again"):
            await task

    live(work)


def test_a_program_that_does_not_start_has_no_version_before(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        bench.dora.then["ReplaceNode"] = bench.crash
        with pytest.raises(DoraSystemdError, match=r"^cannot use what was saved: node a"):
            await bench.by_hand("a")
        assert bench.reloaded == ["a"]

    live(work)


async def whole(bench: Bench) -> "asyncio.Task[list[str]]":
    """The dataflow as a whole has to start again; its run is told to end."""
    bench.begin()
    bench.write("ac")
    task = asyncio.create_task(bench.reloader._reload([str(bench.flow)]))
    await until(lambda: bench.pump.cell.reload)
    return task


def test_what_dora_cannot_change_starts_again_as_a_whole(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING)
        task = await whole(bench)
        assert not bench.asked
        assert not task.done(), "it is good when the next run has started"
        bench.reloader.has_started()
        (done,) = await task
        assert done.startswith("the dataflow was reloaded: not all nodes were ready; ready after ")
        assert bench.reloader.before is None
        assert not bench.reloader.go_back("later"), "there is no way back any more"

    live(work)


def test_the_version_before_comes_back_when_the_next_run_fails(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, State.WAITING)
        task = await whole(bench)
        before = bench.reloader.before
        assert before is not None
        assert bench.reloader.patience == 30
        assert bench.reloader.go_back("node c: exit code 1")
        assert bench.reloader.current is before
        with pytest.raises(DoraSystemdError, match=r"cannot use .*: node c: exit code 1$"):
            await task
        assert bench.reloader.notice == "not reloaded: node c: exit code 1"

    live(work)


def test_what_is_asked_for_otherwise(tmp_path: Path) -> None:
    async def work() -> None:
        with pytest.raises(DoraSystemdError, match="cannot do ") as caught:
            await Bench(tmp_path).reloader.answer({"verb": "dance"})
        assert caught.value.code is ExitCode.USAGE

    live(work)
