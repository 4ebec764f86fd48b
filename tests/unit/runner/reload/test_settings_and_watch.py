"""Reloads that must not go deaf, and that lose nothing that was saved."""

import asyncio
import os
import time
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from dora_systemd.adapters.dora.preparation import Prepared, prepare
from dora_systemd.decisions.cell.line_rates import RateLimits, parse_rate, rates_of
from dora_systemd.decisions.cell.options import RunnerOptions, SettingText
from dora_systemd.decisions.cell.status import NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Cell, State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.runner.reload.apply import Run
from dora_systemd.runner.reload.reloader import Reloader
from dora_systemd.runner.reload.settings_file import SettingsFile, main
from dora_systemd.runner.reload.sources import Versions, Watcher, check_programs
from dora_systemd.values import SECOND

FLOW = "nodes: [{{id: a, path: {path}}}]\n"


class Bench:
    """A dataflow on disk, and a reloader whose run is a record of what it is told."""

    def __init__(self, root: Path, settings: type[SettingsFile] = SettingsFile) -> None:
        self.root = root
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.pushed: list[life.Event] = []
        self.limited: list[RateLimits] = []
        self.flow = root / "flow.yml"
        self.settings = root / "flow.systemd.yml"
        self.copy = root / "settings.yml"
        self.write("a.py")
        options = RunnerOptions("robot", "uuid", str(self.flow), str(root), "/bin/true")
        self.reloader = Reloader(options, {}, settings(str(self.settings), self.copy))
        self.options = options

    def write(self, path: str) -> None:
        (self.root / path).write_text("")
        self.flow.write_text(FLOW.format(path=path))

    def begin(self) -> Prepared:
        cell = Cell(SECOND, 0, {"a": NodeStatus("running", 7)}, State.RUNNING)
        pump = SimpleNamespace(cell=cell, push=self.pushed.append)
        pipes = SimpleNamespace(write_event=self.write_event)
        nodes = SimpleNamespace(limit=lambda _: None, limit_lines=self.limited.append)
        prepared = prepare(self.options, {})
        run = cast(Run, SimpleNamespace(pump=pump, pipes=pipes, nodes=nodes))
        self.reloader.begin(run, prepared, self.flow.stat().st_ctime_ns)
        return prepared

    def write_event(self, name: str, _: str | None = None, **details: Any) -> None:
        self.events.append((name, details))

    @property
    def reasons(self) -> list[str]:
        return [one["reason"] for name, one in self.events if name == "reload-failed"]


def live(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(work())


async def at_work(bench: Bench, check: Callable[[asyncio.Task[None]], Awaitable[None]]) -> None:
    task = asyncio.create_task(bench.reloader.work())
    await asyncio.sleep(0)
    await check(task)
    task.cancel()
    bench.reloader.close()


@pytest.mark.parametrize("is_early", [True, False])
def test_settings_that_cannot_be_read_are_told_and_reloads_go_on(
    tmp_path: Path, is_early: bool
) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        os.mkfifo(bench.settings)  # root may read all else
        if is_early:
            bench.begin()

        async def check(task: asyncio.Task[None]) -> None:
            assert not task.done(), "it listens"
            if not is_early:
                bench.begin()
            assert bench.reasons == [
                f"cannot read {bench.settings}: it is not a regular file (give a file)"
            ]
            (notice,) = bench.pushed
            assert isinstance(notice, life.ReloadNoted)
            assert "not reloaded: cannot read" in notice.notice

        await at_work(bench, check)

    live(work)


def test_watching_that_breaks_is_told(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        options = bench.options._replace(dataflow=cast(Any, None))
        await bench.reloader._watcher.collect(options)
        assert "cannot watch files any more: TypeError" in bench.reasons[0]

    live(work)


def test_each_version_of_the_settings_is_read_once(tmp_path: Path) -> None:
    class Saved(SettingsFile):
        """Saved again just after it was read."""

        def change(self) -> tuple[tuple[SettingText, ...], tuple[str, ...]]:
            self.take()
            Path(self.path).write_text("memory_limit: 3G\n")
            return (), ()

    async def work() -> None:
        bench = Bench(tmp_path, Saved)
        bench.settings.write_text("memory_limit: 1G\n")
        bench.reloader._settings.keep()
        run = bench.begin()
        assert run is bench.reloader.current
        bench.settings.write_text("memory_limit: 2G\n")
        await bench.reloader._reload([str(bench.settings)])
        assert bench.copy.read_text() == "memory_limit: 2G\n"
        assert bench.settings.read_text() == "memory_limit: 3G\n"

    live(work)


def test_hot_reload_takes_over_nothing_by_being_switched_on(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        before = bench.begin()
        bench.write("b.py")
        await bench.reloader.answer({"verb": "hot-reload", "on": True})
        current = bench.reloader.current
        assert current is not None
        assert current.dataflow == before.dataflow
        assert current.plan.options.hot_reload, "how it treats nodes that fail is new"
        assert current.descriptor != before.descriptor
        assert bench.reloader._changed_since() == [str(bench.flow)], "reload will find it"
        bench.reloader.close()

    live(work)


def test_a_save_that_waits_is_not_reloaded_once_hot_reload_is_off(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        bench.begin()
        (bench.root / "a.py").write_text("saved")
        saved = [str(bench.root / "a.py")]

        async def check(_: asyncio.Task[None]) -> None:
            async with bench.reloader._lock:  # of the reload before
                request = {"verb": "hot-reload", "on": False}
                off = asyncio.create_task(bench.reloader.answer(request))
                await asyncio.sleep(0)
                bench.reloader._take_files(frozenset(saved))
                await asyncio.sleep(0)
            await off
            async with bench.reloader._lock:  # whoever waited for the lock has had it
                assert not bench.events
            assert bench.reloader._changed_since() == saved, "reload will find it"

        await at_work(bench, check)

    live(work)


def test_limits_of_lines(tmp_path: Path) -> None:
    """They hold for the nodes that run, for those that a reload adds, and for the next run."""
    rates = {"": parse_rate("9/1s"), "a": None}
    limits = ["log_rate_limit=9/1s", "a:log_rate_limit=infinity"]

    async def work() -> None:
        bench = Bench(tmp_path)
        for begin in (lambda: None, bench.begin):
            begin()
            await bench.reloader.answer({"verb": "log-rates", "limits": limits})
            assert rates_of(bench.reloader.options) == rates
        assert bench.limited == [rates]
        with pytest.raises(DoraSystemdError, match="cannot read 'x' as a rate"):
            await bench.reloader.answer({"verb": "log-rates", "limits": ["log_rate_limit=x"]})
        assert rates_of(bench.reloader.options) == rates
        bench.reloader.close()

    live(work)


def test_versions_of_a_settings_file(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before, after = tmp_path / "settings.yml", tmp_path / "settings.yml.read"
    before.write_text("nodes: {a: {memory_limit: 1G}}\n")
    after.write_text("nodes: {a: {memory_limit: 2G}}\nnice: 5\n")
    assert main(str(before), str(after), "/srv/flow.systemd.yml") == 0
    assert capfd.readouterr().out == '{"limits": ["a:memory_limit=2G"], "others": ["nice"]}\n'
    after.write_text("nodes: [")
    assert main(str(before), str(after), "/srv/flow.systemd.yml") != 0
    assert "cannot read /srv/flow.systemd.yml: line" in capfd.readouterr().err


def test_a_settings_file_that_goes_and_comes(tmp_path: Path) -> None:
    path, copy = tmp_path / "flow.systemd.yml", tmp_path / "settings.yml"
    settings = SettingsFile(str(path), copy)
    path.write_text("nice: 5\n")
    settings.keep()
    assert copy.read_text() == "nice: 5\n"
    path.unlink()
    settings.keep()
    assert not copy.exists()
    path.mkdir()
    with pytest.raises(DoraSystemdError, match="it is a directory"):
        settings.keep()


def test_a_program_that_is_no_python_is_not_read(tmp_path: Path) -> None:
    """It may have a gigabyte, which the runner would take from its nodes."""
    program, gone = tmp_path / "node", str(tmp_path / "gone")
    with program.open("wb") as file:
        file.truncate(1 << 40)
    (tmp_path / "link").symlink_to(tmp_path)
    check_programs([str(program), str(tmp_path / "link")])
    with pytest.raises(DoraSystemdError, match=f"^cannot use {gone}: No such file"):
        check_programs([gone])


def test_a_name_that_leaves_no_room_for_settings(tmp_path: Path) -> None:
    settings = SettingsFile(str(tmp_path / ("x" * 256)), tmp_path / "copy")
    settings.keep()
    assert not (tmp_path / "copy").exists()


def test_whoever_switches_it_on_may_save_at_once(tmp_path: Path) -> None:
    async def work() -> None:
        bench = Bench(tmp_path)
        seen: list[str] = []
        watcher = Watcher(seen.extend, bench.reloader._refusing)
        watcher.watch(bench.options._replace(working_directory=str(tmp_path)))
        await watcher.wait_seeing()
        (tmp_path / "node.py").write_text("new")
        async with asyncio.timeout(20):
            while not seen:
                await asyncio.sleep(0.01)
        assert seen == [str(tmp_path / "node.py")]
        watcher.watch(None)
        await watcher.wait_seeing()

    live(work)


@pytest.mark.parametrize("is_saved", [True, False])
def test_a_file_that_is_saved_while_versions_are_noted_stays_unknown(
    tmp_path: Path, is_saved: bool
) -> None:
    """The paths come one after the other, from a search that takes its time."""
    path = tmp_path / "words.py"
    path.touch()
    begun_ns = time.time_ns()
    versions = Versions()

    def found() -> list[str]:
        if is_saved:
            while path.stat().st_ctime_ns <= begun_ns:  # the clock of files has ticks
                os.utime(path)
        return [str(path)]

    versions.add("sink", found(), begun_ns)
    assert versions.stale("sink", [str(path)]) == ({str(path)} if is_saved else set())
