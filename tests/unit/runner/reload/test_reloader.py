"""Reloads from the save of a file to what the operator is told about it."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from dora_systemd import __version__
from dora_systemd.adapters.dora.preparation import prepare
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import State
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.settings_file import SettingsFile
from tests.unit.fakes.loop import within
from tests.unit.fakes.manager import with_texts
from tests.unit.fakes.reload import ReloadBench


class Bench(ReloadBench):
    """A reloader of a dataflow of the nodes a and b, which runs."""

    def __init__(self, root: Path, state: State = State.RUNNING, is_hot: bool = False) -> None:
        super().__init__(root, state)
        self.options = with_texts(self.options, f"hot_reload={is_hot}".lower())
        self.prepared = self.write("ab")
        settings = SettingsFile(str(root / "flow.systemd.yml"), root / "settings.yml")
        self.reloader = Reloader(self.options, {}, settings)

    def begin(self) -> None:
        self.reloader.begin(self.run, prepare(self.options, {}), time.time_ns())

    def see(self, *names: str) -> None:
        """Save these, and do what the watch of files does then."""
        for name in names:
            (self.root / name).write_text(f"# {len(self.asked)}\n")
        self.reloader._changed |= {str(self.root / name) for name in names}
        self.reloader._wake.set()

    async def by_hand(self, node: str = "") -> Any:
        return (await self.reloader.answer({"verb": "reload", "node": node}))["done"]

    @property
    def reloaded(self) -> list[str]:
        return [node for method, node in self.asked if method == "RemoveNode"]


async def until(is_so: Callable[[], object]) -> None:
    while not is_so():
        await asyncio.sleep(0.001)


def live(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(within(20, work()))


def test_a_save_while_a_reload_is_under_way_is_not_lost(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        bench.dora.then["AddNode"] = lambda: None  # a is not ready yet
        task = asyncio.create_task(bench.reloader.work())
        bench.see("a.py")
        await until(lambda: bench.reloaded == ["a"])
        bench.see("b.py")
        await asyncio.sleep(0)
        assert bench.reloaded == ["a"], "one after the other"
        bench.dora.then["AddNode"] = bench.spawn
        bench.spawn()
        await until(lambda: bench.reloaded == ["a", "b"])
        await until(lambda: len(bench.pipes.reasons("node-reloaded")) == 2)
        task.cancel()

    live(work)


@pytest.mark.parametrize(("name", "reloaded"), [("a.py", ["a"]), ("any.json", ["a", "b"])])
def test_a_save_before_the_first_look_at_the_files_is_not_lost(
    tmp_path: Path, name: str, reloaded: list[str]
) -> None:
    """On a busy machine a start can be over before that."""

    async def work() -> None:
        bench, began_ns = Bench(tmp_path, is_hot=True), time.time_ns()
        bench.begin()
        await until(lambda: is_saved_after(began_ns, tmp_path / name))
        task = asyncio.create_task(bench.reloader.work())
        await until(lambda: len(bench.pipes.reasons("node-reloaded")) == len(reloaded))
        assert sorted(bench.reloaded) == reloaded
        task.cancel()
        bench.reloader.close()

    live(work)


def is_saved_after(began_ns: int, path: Path) -> bool:
    """Save the file; whether that was later: the time of a change may be that of the last tick."""
    path.write_text("# saved")
    return path.stat().st_ctime_ns > began_ns


def test_two_reloads_by_hand_follow_each_other(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        bench.dora.then["AddNode"] = lambda: None
        first, second = (asyncio.create_task(bench.by_hand(node)) for node in "ab")
        await until(lambda: bench.reloaded)
        for _ in range(20):
            await asyncio.sleep(0.001)
        assert bench.reloaded == ["a"]
        bench.dora.then["AddNode"] = bench.spawn
        bench.spawn()
        await asyncio.gather(first, second)
        assert bench.reloaded == ["a", "b"]

    live(work)


def test_a_save_between_two_runs_waits_for_the_next_one(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        task = asyncio.create_task(bench.reloader.work())
        prepared = prepare(bench.options, {})
        bench.write("abc")
        bench.see("flow.yml", "a.py")
        bench.write("abc")
        await asyncio.sleep(0.01)
        assert not bench.asked
        bench.reloader.begin(bench.run, prepared, time.time_ns())
        await until(lambda: bench.asked)
        assert bench.asked == [("AddNode", "c")], "it begins with the present program"
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


def swap_directory(root: Path) -> None:
    """Move a directory away, and another one there, which is older."""
    root.rename(root.with_name("before"))
    root.with_name("other").rename(root)


def swap_program(root: Path) -> None:
    """Have a link lead to another program, which is older."""
    (root / "link").unlink()
    (root / "link").symlink_to("b2.py")


def swap_module(root: Path) -> None:
    """Move an older module there."""
    (root / "lib").rename(root / "lib1")
    (root / "lib2").rename(root / "lib")


SWAPS = [
    (swap_directory, ["a", "b"]),
    (swap_program, ["b"]),
    (swap_module, ["a"]),
    (lambda _: None, []),
]


@pytest.mark.parametrize(("swap", "expected"), SWAPS)
def test_another_file_behind_a_path(
    tmp_path: Path, swap: Callable[[Path], None], expected: list[str]
) -> None:
    """All files are older than the run, as where the clock was set back."""

    async def work() -> None:
        for name in ("other", "project"):
            (root := tmp_path / name).mkdir()
            for module in ("lib", "lib2"):
                (root / module).mkdir()
                (root / module / "part.py").write_text(f"NAME = {module!r}\n")
            (root / "b1.py").touch()
            (root / "b2.py").touch()
            (root / "link").symlink_to("b1.py")
            bench = Bench(root)
            (root / "a.py").write_text("import lib.part\n")
            (root / "b.py").unlink()
            (root / "b.py").symlink_to("link")
            (root / "b2.py").write_text("pass\n")
        bench.begin()
        bench.reloader.has_started()
        assert await bench.by_hand() == []
        swap(root)
        assert len(await bench.by_hand()) == len(expected)
        assert sorted(bench.reloaded) == expected
        assert await bench.by_hand() == []

    live(work)


def test_a_file_that_is_away_and_comes_back_as_it_was(tmp_path: Path) -> None:
    async def work() -> None:
        (root := tmp_path / "project").mkdir()
        bench = Bench(root)
        bench.begin()
        root.rename(tmp_path / "away")
        with pytest.raises(DoraSystemdError, match="there is no such file") as caught:
            await bench.by_hand()
        assert caught.value.code is ExitCode.BAD_INPUT
        (tmp_path / "away").rename(root)
        await bench.reloader._reload([str(root / "a.py")])
        assert await bench.by_hand() == []
        assert not bench.asked

    live(work)


def test_a_node_that_is_added_with_its_program(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        (tmp_path / "c.py").touch()
        with bench.flow.open("a") as file:
            file.write("  - {id: c, path: c.py}\n")
        (done,) = await bench.reloader._reload([str(bench.flow), str(tmp_path / "c.py")])
        assert done.startswith("the node c was added: ")
        assert await bench.by_hand() == []
        assert bench.asked == [("AddNode", "c")]
        (tmp_path / "c.py").write_text("pass\n")
        await bench.by_hand()
        assert bench.reloaded == ["c"]

    live(work)


def test_one_node_by_hand_takes_its_files_and_no_others(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        for name in "ab":
            (tmp_path / f"{name}.py").write_text("import shared\n")
        (tmp_path / "shared.py").touch()
        bench.begin()
        bench.reloader.has_started()
        assert await bench.by_hand() == []
        (tmp_path / "shared.py").write_text("pass\n")
        for node in ("a", "", ""):
            await bench.by_hand(node)
        assert bench.reloaded == ["a", "b"]

    live(work)


def test_what_was_refused_together_is_not_lost(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        task = asyncio.create_task(bench.reloader.work())
        bench.see("a.py")
        (tmp_path / "b.py").write_text("def broken(:\n")
        bench.reloader._changed.add(str(tmp_path / "b.py"))
        await until(lambda: bench.pipes.reasons("reload-failed"))
        assert not bench.reloaded
        bench.see("b.py")
        await until(lambda: len(bench.reloaded) == 2)
        assert sorted(bench.reloaded) == ["a", "b"]
        task.cancel()

    live(work)


def test_a_node_that_somebody_has_removed_or_added(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        with pytest.raises(DoraSystemdError, match=r"cannot reload the node z: it is not in "):
            await bench.by_hand("z")
        bench.pump.push(life.NodeRemoved(5, "b"))
        (tmp_path / "b.py").write_text("pass\n")
        task = asyncio.create_task(bench.by_hand())
        await until(lambda: bench.pump.cell.reload)
        bench.reloader.has_started()
        (done,) = await task
        assert "the node b had been removed" in done

    live(work)


def test_a_link_that_leads_to_another_dataflow(tmp_path: Path) -> None:
    """All of it starts again, and comes back if the other one does not start."""

    async def work() -> None:
        for name in ("2", "1"):
            (tmp_path / name).mkdir()
            bench = Bench(tmp_path / name)
        link = tmp_path / "current"
        link.symlink_to("1")
        given = bench.options._replace(dataflow=str(link / "flow.yml"), working_directory=str(link))
        settings = SettingsFile(str(tmp_path / "1/flow.systemd.yml"), tmp_path / "settings.yml")
        reloader = bench.reloader = Reloader(bench.options, {}, settings, given)
        bench.begin()
        assert await bench.by_hand() == []
        link.unlink()
        link.symlink_to("2")
        (tmp_path / "2/b.py").write_text("def broken(:\n")
        assert reloader._has_moved()
        with pytest.raises(DoraSystemdError, match=r"cannot use .*/2/b\.py"):
            await bench.by_hand()
        assert not reloader._has_moved(), "hot reload tries it once"
        assert reloader.options.dataflow == str(bench.flow)
        (tmp_path / "2/b.py").write_text("")
        cell = bench.pump.cell
        for outcome in ("node a: exit code 1", ""):
            bench.pump.cell = cell
            task = asyncio.create_task(bench.by_hand())
            await until(lambda: bench.pump.cell.reload)
            assert reloader.options.dataflow == str(tmp_path / "2/flow.yml")
            if outcome:
                assert reloader.go_back(outcome)
                with pytest.raises(DoraSystemdError, match=r"cannot use .*/2/flow\.yml: node a"):
                    await task
                assert reloader.options.dataflow == str(bench.flow)
        reloader.has_started()
        (done,) = await task
        assert f"its path leads to {tmp_path}/2 now" in done
        reloader.close()

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
        bench.dora.then["AddNode"] = bench.crash
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
        assert f"the runner is of dora-systemd {__version__}" in caught.value.message

    live(work)


@pytest.mark.parametrize("is_hot", [True, False])
def test_only_hot_reload_reads_all_imports_after_a_start(tmp_path: Path, is_hot: bool) -> None:
    async def work() -> None:
        bench = Bench(tmp_path, is_hot=is_hot)
        bench.begin()
        bench.reloader.has_started()
        assert len(asyncio.all_tasks()) == 1 + is_hot

    live(work)
