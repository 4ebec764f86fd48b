"""Watched files, with the real inotify."""

import asyncio
import shutil
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import watchfiles

from dora_systemd.adapters.host import watch
from dora_systemd.decisions.reload.watch_rules import WatchRules
from dora_systemd.errors import DoraSystemdError
from tests.lab.pace import bound
from tests.unit.fakes.manager import options, with_texts

SECONDS = 20.0


async def first(
    rules: WatchRules, idle_ms: int = watch.IDLE_MS, seconds: float = SECONDS
) -> frozenset[str]:
    """The first batch of changed files."""
    async with asyncio.timeout(seconds):
        async for files in watch.changed_files(rules, idle_ms=idle_ms):
            return files
    raise AssertionError


@pytest.mark.parametrize("others", [(), ("other.py",)])
def test_a_save_before_the_watches_exist_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, others: tuple[str, ...]
) -> None:
    """watchfiles takes a while to load: on a slow machine somebody saves meanwhile."""
    real = watchfiles.awatch
    saved = tmp_path / "node.py"
    saved.write_text("")

    async def late(*directories: str, **options: Any) -> AsyncIterator[Any]:
        saved.unlink()
        saved.write_text("changed")
        asyncio.get_running_loop().call_later(0.2, save, *others)
        async for changes in real(*directories, **options):
            yield changes

    def save(*names: str) -> None:
        for name in names:
            (tmp_path / name).write_text("")

    monkeypatch.setattr(watchfiles, "awatch", late)
    found = asyncio.run(first(WatchRules(str(tmp_path), ("*.py",)), 1000))
    assert found == {str(saved), *(str(tmp_path / name) for name in others)}


LATER, EARLIER = 5, -5
"""Seconds from the save of the file to the start of the run."""
KNOWN: dict[str, tuple[int, str, str, bool]] = {
    "saved after the start": (EARLIER, "node.py", "", True),
    "saved before it": (LATER, "node.py", "", False),
    "the version that runs": (EARLIER, "node.py", "same", False),
    "another one, whatever the clock says": (LATER, "node.py", "other", True),
    "it has gone": (LATER, "gone.py", "same", True),
    "it has come": (LATER, "node.py", "none", True),
    "nobody watches it": (LATER, "node.txt", "other", False),
}


@pytest.mark.parametrize(("after", "name", "version", "is_found"), KNOWN.values(), ids=KNOWN)
def test_a_save_between_the_start_and_the_first_look(
    tmp_path: Path, after: int, name: str, version: str, is_found: bool
) -> None:
    (tmp_path / "other.py").write_text("")
    other = watch.identity(str(tmp_path / "other.py"))
    (tmp_path / "other.py").unlink()
    saved = tmp_path / name
    saved.write_text("")
    known = {"same": watch.identity(str(saved)), "other": other, "none": None}
    pairs = [(str(saved), known[version])] if version else []
    if name.startswith("gone"):
        saved.unlink()
    began_ns = time.monotonic_ns() + after * 1_000_000_000
    seen = watch.Seen(WatchRules(str(tmp_path), ("*.py",)))
    found = seen.first(watch.Since(began_ns, lambda: pairs))
    assert found == ({str(saved)} if is_found else set())
    assert not seen.missed(), "it is reported once"


def test_what_is_unchanged_is_not_told(tmp_path: Path) -> None:
    (tmp_path / "node.py").write_text("")
    with pytest.raises(TimeoutError):
        asyncio.run(first(WatchRules(str(tmp_path), ("*.py",)), 100, seconds=1.0))


def test_a_directory_that_a_pattern_matches_is_no_file(tmp_path: Path) -> None:
    """It cannot be read, so each reload would be refused from then on."""
    made = tmp_path / "conf/made"
    made.parent.mkdir()

    async def save() -> None:
        await asyncio.sleep(1)
        made.mkdir()
        (tmp_path / "conf/saved").write_text("")

    async def both() -> frozenset[str]:
        return (await asyncio.gather(first(WatchRules(str(tmp_path), ("conf/*",))), save()))[0]

    assert asyncio.run(both()) == {str(tmp_path / "conf/saved")}


@pytest.mark.parametrize("of_all", [(), ("watch=*.txt",)])
def test_further_files_of_nodes_are_watched(tmp_path: Path, of_all: tuple[str, ...]) -> None:
    given = options(working_directory=str(tmp_path))
    texts = ("camera:watch=extra/**", "camera:watch=!extra/not", "arm:watch=*.map", "ignore=old.*")
    rules = watch.watch_rules(with_texts(given, *texts, *of_all))
    every = ["a.py", "a.txt", "extra/in/a.bin", "extra/not", "a.map", "old.map", "a.bin", "a.csv"]
    found = [name for name in every if rules.has(f"{tmp_path}/{name}")]
    assert found == ["a.txt" if of_all else "a.py", "extra/in/a.bin", "a.map"]


def test_a_change_that_watchfiles_drops_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It arrives between a copy and the clearing of the original."""
    given, dropped = tmp_path / "given.py", tmp_path / "dropped.py"

    async def drops(*_: str, **__: Any) -> AsyncIterator[Any]:
        yield set()
        given.write_text("")
        yield {(watchfiles.Change.added, str(given))}
        dropped.write_text("")
        yield set()
        await asyncio.Event().wait()

    async def batches() -> list[frozenset[str]]:
        found = []
        async with asyncio.timeout(SECONDS):
            async for files in watch.changed_files(WatchRules(str(tmp_path), ("*.py",))):
                found.append(files)
                if len(found) == 2:
                    break
        return found

    monkeypatch.setattr(watchfiles, "awatch", drops)
    assert asyncio.run(batches()) == [{str(given)}, {str(dropped)}]


def test_a_directory_that_has_gone_for_good_takes_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The dataflow file may be apart from its project; the project is still looked at."""
    asked: list[tuple[str, ...]] = []
    real = watchfiles.awatch

    def count(*directories: str, **options: Any) -> AsyncIterator[Any]:
        asked.append(directories)
        return real(*directories, **options)

    monkeypatch.setattr(watchfiles, "awatch", count)
    flow, saved = tmp_path / "gone/flow.yml", tmp_path / "project/node.py"
    saved.parent.mkdir()
    rules = WatchRules(str(saved.parent), ("*.py",), files=frozenset({str(flow)}))

    async def save() -> None:
        await asyncio.sleep(1)
        saved.write_text("")

    async def both() -> frozenset[str]:
        return (await asyncio.gather(first(rules), save()))[0]

    assert asyncio.run(both()) == {str(saved)}
    assert 0 < len(asked) < 10


REPLACED = {
    "moved away, and back later": ("project", True, 0),
    "its parent moved away, and another one there": ("", False, 1),
    "another one there at once": ("project", False, 1),
}


@pytest.mark.parametrize(("name", "is_back", "count"), REPLACED.values(), ids=REPLACED)
def test_a_project_that_is_replaced(tmp_path: Path, name: str, is_back: bool, count: int) -> None:
    """What is saved in the new one is noticed; what comes back as it was is not reported."""
    place = tmp_path / "place"
    for one in ("place", "other"):
        (tmp_path / one / "project").mkdir(parents=True)
        (tmp_path / one / "project/node.py").write_text(one)
    node = place / "project/node.py"
    rules = WatchRules(str(place / "project"), ("*.py",))
    batches: list[frozenset[str]] = []

    async def collect() -> None:
        async for files in watch.changed_files(rules, idle_ms=1000):
            batches.append(frozenset(path for path in files if Path(path).exists()))

    async def until_found(number: int) -> None:
        async with asyncio.timeout(SECONDS):
            while len([one for one in batches if one]) < number:
                await asyncio.sleep(0.01)

    async def work() -> None:
        task = asyncio.create_task(collect())
        await asyncio.sleep(1)
        (place / name).rename(tmp_path / "before")
        if is_back:
            await asyncio.sleep(1)
        (tmp_path / ("before" if is_back else f"other/{name}")).rename(place / name)
        await until_found(count)
        await asyncio.sleep(1)
        assert [one for one in batches if one] == [{str(node)}] * count
        node.write_text("new")
        await until_found(count + 1)
        task.cancel()

    asyncio.run(work())


def move_away(place: Path, other: Path) -> None:
    place.rename(other.with_name("before"))


def move_in(place: Path, other: Path) -> None:
    other.rename(place)


def remove(place: Path, _: Path) -> None:
    shutil.rmtree(place)


def copy_in(place: Path, other: Path) -> None:
    shutil.copytree(other, place)


Step = Callable[[Path, Path], None]
AWAY: dict[str, tuple[Step, float, Step]] = {
    "moved away, and another one there later": (move_away, 1.2, move_in),
    "removed, and copied there later": (remove, 1.2, copy_in),
    "removed, and copied there soon": (remove, 0.3, copy_in),
}


@pytest.mark.parametrize(("leave", "seconds", "come"), AWAY.values(), ids=AWAY)
def test_a_project_that_was_away_is_seen_at_once(
    tmp_path: Path, leave: Step, seconds: float, come: Step
) -> None:
    """Not only when watchfiles has waited in vain for a change, which never happens here."""
    place, other = tmp_path / "project", tmp_path / "other"
    for one in (place, other):
        (one / "lib").mkdir(parents=True)
        (one / "node.py").write_text(one.name)
        (one / "lib/part.py").write_text(one.name)
    node, part = str(place / "node.py"), str(place / "lib/part.py")
    rules, looks = WatchRules(str(place), ("*.py",)), asyncio.Event()
    found: list[str] = []

    async def collect() -> None:
        async for files in watch.changed_files(rules, looks.set, idle_ms=600_000):
            found.extend(path for path in files if Path(path).exists())

    async def until_found(*paths: str) -> None:
        async with asyncio.timeout(bound(3)):
            while not set(paths) <= set(found):
                await asyncio.sleep(0.01)
        assert set(found) <= {node, part}
        found.clear()

    async def work() -> None:
        task = asyncio.create_task(collect())
        await looks.wait()
        Path(node).write_text("first")
        await until_found(node)
        leave(place, other)
        await asyncio.sleep(seconds)
        come(place, other)
        await until_found(node, part)
        Path(part).write_text("new")
        await until_found(part)
        task.cancel()

    asyncio.run(work())


def test_a_directory_that_comes_before_the_watches_exist_is_watched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when a project is copied to its place, one directory after the other."""
    real = watchfiles.awatch
    saved = tmp_path / "lib/part.py"

    async def late(*directories: str, **options: Any) -> AsyncIterator[Any]:
        if not saved.exists():
            saved.parent.mkdir()
            saved.write_text("")
        async for changes in real(*directories, **options):
            yield changes

    async def save_twice() -> list[frozenset[str]]:
        found = []
        rules = WatchRules(str(tmp_path), ("*.py",))
        async with asyncio.timeout(bound(5)):
            async for files in watch.changed_files(rules, idle_ms=600_000):
                found.append(files)
                if len(found) == 2:
                    break
                asyncio.get_running_loop().call_later(1, saved.write_text, "changed")
        return found

    monkeypatch.setattr(watchfiles, "awatch", late)
    assert asyncio.run(save_twice()) == [{str(saved)}] * 2


def test_hot_reload_where_nothing_can_watch_files() -> None:
    watch.require_watcher()
    with pytest.raises(DoraSystemdError) as caught:
        watch.require_watcher(lambda _: None)
    assert caught.value.message == (
        "cannot use hot reload: this system has no Python package watchfiles"
    )
