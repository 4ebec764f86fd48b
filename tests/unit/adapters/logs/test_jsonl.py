"""dora's own log file: complete over append, rotation and truncation."""

import asyncio
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path, PosixPath
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.logs.jsonl import POLL_SECONDS, QUIET_POLLS, JsonlTail, resume_tail
from dora_systemd.decisions.logs.lines import Value


class Dora:
    """Writes the file as dora's daemon does."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "log_a.jsonl"
        self.count = 0

    def write(self, lines: int = 1) -> None:
        with self.path.open("a") as file:
            for _ in range(lines):
                record = {"ts": "t", "level": "stdout", "stream": "stdout", "msg": str(self.count)}
                file.write(json.dumps(record) + "\n")
                self.count += 1

    def rotate(self, keep: int) -> None:
        if not self.path.exists():
            return
        for number in range(keep, 0, -1):
            newer = self.path.with_name(f"log_a.{number - 1}.jsonl") if number > 1 else self.path
            if newer.exists():
                newer.rename(self.path.with_name(f"log_a.{number}.jsonl"))


def tail(loop: asyncio.AbstractEventLoop, dora: Dora) -> tuple[JsonlTail, list[str]]:
    found: list[str] = []
    return JsonlTail(loop, dora.path, lambda fields: found.append(str(fields["MESSAGE"]))), found


def numbers(count: int) -> list[str]:
    return [str(number) for number in range(count)]


def test_appended(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    follower.drain()
    for _ in range(3):
        dora.write(2)
        follower.drain()
    assert found == numbers(6)
    follower.close()


def test_many_lines(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    dora.write(10_000)
    follower, found = tail(loop, dora)
    follower.close()
    assert found == numbers(10_000)


def test_a_kill_and_who_comes_after(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    """The place that is noted is that of what the journal has, over rotations too."""
    (tmp_path / "two words").mkdir()
    dora, place = Dora(tmp_path / "two words"), tmp_path / "a.place"
    busy: list[int] = []
    found: list[str] = []

    def put(fields: dict[str, Value]) -> None:
        found.append(str(fields["MESSAGE"]))

    first = JsonlTail(loop, dora.path, put, lambda: bool(busy), place)
    first.start()
    assert resume_tail(loop, place, put) is None
    dora.write(5)
    first.start()
    with dora.path.open("a") as file:
        file.write('{"ts": "t", "level": "stdout", ')
    first.start()
    assert found == numbers(5)
    with dora.path.open("a") as file:
        file.write('"stream": "stdout", "msg": "5"}\n')
    dora.count = 6
    dora.rotate(2)
    dora.write(4)
    second = resume_tail(loop, place, put)
    assert second is not None
    second.close()
    assert found == numbers(10)
    busy.append(1)  # what was read but not taken stays behind the place
    first.drain()
    first.start()
    found.clear()
    third = resume_tail(loop, place, put)
    assert third is not None
    third.close()
    assert found == numbers(10)[5:]
    first.close()


def truncate(dora: Dora, follower: JsonlTail) -> None:
    """Three lines that were read, and a fourth at the beginning again."""
    dora.write(3)
    follower.drain()
    dora.path.write_text("")
    dora.write(1)


def test_truncated_by_dora_1_0(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    truncate(dora, follower)
    follower.close()
    assert found == numbers(4)


STEPS = st.lists(st.sampled_from(["write", "rotate", "look"]), max_size=30)


@given(STEPS)
def test_rotated(tmp_path_factory: pytest.TempPathFactory, steps: list[str]) -> None:
    loop = asyncio.new_event_loop()
    dora = Dora(tmp_path_factory.mktemp("out"))
    follower, found = tail(loop, dora)
    for step in steps:
        if step == "write":
            dora.write(3)
        elif step == "rotate":
            dora.rotate(keep=40)
        else:
            follower.drain()
    follower.close()
    loop.close()
    assert found == numbers(dora.count)
    assert follower.lost_files == 0
    assert follower.loss == ""


def test_deleted_before_it_was_read(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    dora.write()
    follower.drain()
    for _ in range(3):
        dora.write()
        dora.rotate(keep=1)
    dora.write()
    follower.close()
    assert found == ["0", "1", "3", "4"]
    assert follower.loss == "dora deleted 1 of its log files before they were read"


def test_each_deleted_file_is_counted(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, _ = tail(loop, dora)
    for _ in range(2):
        dora.write()
        follower.drain()
        for _ in range(2):
            dora.rotate(keep=1)
            dora.write()
        follower.drain()
    follower.close()
    assert follower.loss == "dora deleted 2 of its log files before they were read"


def test_when_it_reads_again(tmp_path: Path) -> None:
    """At once while there is more: dora may rotate the file."""
    delays: list[float] = []

    def call_later(delay: float, _: object) -> object:
        delays.append(delay)
        return SimpleNamespace(cancel=lambda: None)

    loop: Any = SimpleNamespace(call_later=call_later)
    dora, busy = Dora(tmp_path), [False]
    follower = JsonlTail(loop, dora.path, lambda _: None, lambda: busy[0])
    follower.start()
    dora.write()
    for is_busy in (True, False, False):
        busy[0] = is_busy
        follower.start()
    assert delays == [POLL_SECONDS, POLL_SECONDS, 0, POLL_SECONDS]
    follower.close()


def test_backlog_over_rotations(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    assert follower.backlog() == 0
    dora.write(3)
    size = dora.path.stat().st_size
    assert follower.backlog() == size
    follower.drain()
    assert follower.backlog() == 0
    for _ in range(2):
        dora.write(2)
        dora.rotate(keep=2)
    assert follower.backlog() == size // 3 * 4
    dora.path.with_name("log_a.2.jsonl").unlink()
    assert follower.backlog() == size // 3 * 4  # it is still open
    follower.close()
    assert found == numbers(7)


def test_backlog_of_a_truncated_file(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    truncate(dora, follower)
    assert follower.backlog() == dora.path.stat().st_size
    follower.drain()
    assert found == numbers(4)
    follower.close()


def test_drain_ends_while_dora_goes_on(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    dora = Dora(tmp_path)
    found: list[str] = []

    def put(fields: dict[str, Value]) -> None:
        found.append(str(fields["MESSAGE"]))
        dora.write()

    follower = JsonlTail(loop, dora.path, put)
    dora.write(3)
    assert follower.drain()
    assert found == numbers(3)
    follower._put = lambda fields: found.append(str(fields["MESSAGE"]))
    follower.close()
    assert found == numbers(6)


def test_watch_hears_of_the_backlog_while_the_journal_is_busy(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    dora = Dora(tmp_path)
    dora.write(3)
    heard: list[int] = []
    busy = [1]
    follower = JsonlTail(loop, dora.path, lambda _: None, lambda: bool(busy), watch=heard.append)
    follower.start()
    busy.clear()
    follower.start()
    assert heard == [dora.path.stat().st_size, 0]
    follower.close()


def test_waits_while_the_journal_is_busy(tmp_path: Path) -> None:
    async def scenario() -> None:
        dora = Dora(tmp_path)
        dora.write(3)
        found: list[object] = []
        busy = [True]
        loop = asyncio.get_running_loop()
        follower = JsonlTail(loop, dora.path, found.append, lambda: busy[0])
        follower.start()
        await asyncio.sleep(0.12)
        assert not found
        busy[0] = False
        async with asyncio.timeout(60):
            while len(found) < 3:
                await asyncio.sleep(0)
        follower.close()

    asyncio.run(scenario())


def poll(follower: JsonlTail, count: int) -> None:
    """Let so many intervals pass at once."""
    for _ in range(count):
        follower.start()


@pytest.mark.parametrize("is_watched", [True, False])
def test_a_file_that_rests_is_not_polled(
    loop: asyncio.AbstractEventLoop, tmp_path: Path, is_watched: bool
) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)
    asked: list[int] = []

    def watch() -> bool:
        asked.append(dora.count)
        return is_watched

    follower.on_quiet = watch
    dora.write()
    poll(follower, QUIET_POLLS)
    assert asked == [], "the first poll has found a line"
    poll(follower, 1)
    assert asked == [1]
    assert not follower.rests, "one more poll finds what came before the watch"
    poll(follower, 1)
    assert follower.rests is is_watched
    dora.write()
    follower.wake()
    poll(follower, 1)
    assert found == numbers(2)
    assert not follower.rests
    follower.close()


def test_a_line_that_comes_while_the_watch_begins(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    dora = Dora(tmp_path)
    follower, found = tail(loop, dora)

    def watch() -> bool:
        dora.write()
        return True

    follower.on_quiet = watch
    poll(follower, QUIET_POLLS + 1)
    assert found == numbers(1)
    assert not follower.rests
    follower.close()


def test_a_journal_that_is_busy_lets_no_file_rest(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    follower = JsonlTail(loop, Dora(tmp_path).path, lambda _: None, lambda: True)
    follower.on_quiet = lambda: True
    poll(follower, 3 * QUIET_POLLS)
    assert not follower.rests
    follower.close()


class Watched(PosixPath):
    """Lets dora do something right before or after it is looked at, once."""

    before: Callable[[], object] | None = None
    after: Callable[[], object] | None = None

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        if before := self.before:
            self.before = None
            before()
        found = super().stat(follow_symlinks=follow_symlinks)
        if after := self.after:
            self.after = None
            after()
        return found


def test_what_dora_writes_just_before_it_rotates_the_file(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    """After the read that has found nothing more, and before the file has its other name."""
    dora, found = Dora(tmp_path), list[str]()
    watched = Watched(dora.path)
    follower = JsonlTail(loop, watched, lambda fields: found.append(str(fields["MESSAGE"])))
    dora.write(2)
    follower.drain()

    def write_and_rotate() -> None:
        dora.write(2)
        dora.rotate(keep=2)
        dora.write(2)

    watched.before = write_and_rotate
    follower.start()
    assert found == numbers(4), "first the rest of the old file"
    follower.start()
    follower.close()
    assert (found, follower.lost_files) == (numbers(6), 0)


def test_a_file_that_is_gone_when_it_is_opened(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    dora = Dora(tmp_path)
    dora.write(2)
    watched = Watched(dora.path)
    watched.after = dora.path.unlink
    found: list[object] = []
    follower = JsonlTail(loop, watched, found.append)
    follower.resume(dora.path.stat().st_ino, 1)
    assert (follower.backlog(), found) == (0, [])
    dora.write(1)
    follower.close()
    assert len(found) == 1


def test_the_last_line_need_not_end(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    """As where the machine has lost its power."""
    dora = Dora(tmp_path)
    dora.path.write_text('{"ts": "t", "level": "stdout", "stream": "stdout", "msg": "half"}')
    follower, found = tail(loop, dora)
    follower.drain()
    assert found == []
    follower.close()
    assert found == ["half"]


def test_only_its_user_reads_the_place(loop: asyncio.AbstractEventLoop, tmp_path: Path) -> None:
    place = tmp_path / "a.place"
    before = os.umask(0)
    try:
        follower = JsonlTail(loop, tmp_path / "log_a.jsonl", print, place=place)
    finally:
        os.umask(before)
    assert stat.S_IMODE(place.stat().st_mode) == 0o600
    follower.close()


def test_to_close_it_twice_closes_nothing_else(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    dora = Dora(tmp_path)
    dora.write(1)
    follower = JsonlTail(loop, dora.path, lambda _: None, place=tmp_path / "a.place")
    follower.start()
    follower.close()
    reading, writing = os.pipe()  # these have the numbers that were closed
    follower.close()
    os.write(writing, b"x")
    assert os.read(reading, 1) == b"x"
    os.fstat(1)
    for fd in (reading, writing):
        os.close(fd)
