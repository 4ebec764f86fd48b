"""Whenever a runner is killed, its lines are in the journal or left for later."""

import asyncio
import os
import resource
import select
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.logs.held import HeldLines, held_path, read_held
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.logs.lines import LINE_LIMIT, Origin
from tests.unit.adapters.logs.test_queue import SlowJournal

IDENTITY = Origin("robot", "550e8400-e29b-41d4-a716-446655440000")


class Runner:
    """One that reads a FIFO which outlives it."""

    def __init__(self, fifo: Path, journal: SlowJournal) -> None:
        self.loop = asyncio.new_event_loop()
        self.pipes = LogPipes(self.loop, journal, IDENTITY)
        self.fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)

    def turn(self) -> None:
        """What happens when the pipe is readable, if it is looked at."""
        self.loop.call_soon(self.loop.stop)
        self.loop.run_forever()

    def kill(self) -> None:
        self.loop.close()


def messages(journal: SlowJournal) -> list[bytes]:
    entries = [entry for entry in journal.taken if b"DORA_EVENT" not in entry]
    return [entry.split(b"MESSAGE=", 1)[1].removesuffix(b"\n") for entry in entries]


def replayed(fifo: Path) -> list[bytes]:
    """What is written after the end of a runner."""
    journal = SlowJournal()
    journal.room = 1 << 30
    post = Runner(fifo, journal)
    post.pipes.adopt("a", "stdout", post.fd)
    post.pipes.replay("a", fifo)
    post.pipes.drain("a")
    post.kill()
    return messages(journal)


STEPS = st.lists(
    st.tuples(st.just("write"), st.integers(1, 400))
    | st.tuples(st.just("half"), st.just(0))
    | st.tuples(st.sampled_from(["turn", "drain"]), st.just(0))
    | st.tuples(st.just("room"), st.integers(0, 300)),
    max_size=30,
)


@given(STEPS)
def test_a_kill_at_any_time(steps: list[tuple[str, int]]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        fifo = Path(directory) / "a.out"
        os.mkfifo(fifo)
        journal = SlowJournal()
        runner = Runner(fifo, journal)
        runner.pipes.adopt("a", "stdout", runner.fd, HeldLines(fifo))
        expected = b""
        for step, count in steps:
            if step in ("write", "half"):
                start = expected.count(b"\n")
                data = b"".join(b"%d some text\n" % (start + i) for i in range(count)) or b"half "
                written = os.write(runner.fd, data) if len(expected) < 50_000 else 0
                expected += data[:written]
            elif step == "turn":
                runner.turn()
            elif step == "drain":
                runner.pipes.drain("a")
            else:
                journal.make_room(count)
        runner.kill()
        found = [*messages(journal), *replayed(fifo)]
        # A drain ends a line that has not ended: it comes as two.
        assert b"".join(found) == expected.replace(b"\n", b"")
        lines = [line for line in found if line.endswith(b" text")]
        assert len(lines) == expected.count(b" text\n")


def test_parts_of_a_huge_line(fifo: Path) -> None:
    journal = SlowJournal()
    runner = Runner(fifo, journal)
    runner.pipes.adopt("a", "stdout", runner.fd, HeldLines(fifo))
    journal.room = 1
    for _ in range(LINE_LIMIT // 4096 * 2 + 10):
        os.write(runner.fd, b"x" * 4096)
        runner.turn()
    os.write(runner.fd, b"end\n")
    runner.kill()
    found = [*messages(journal), *replayed(fifo)]
    assert b"".join(found) == b"x" * (LINE_LIMIT * 2 + 40960) + b"end"
    assert [len(piece) for piece in found] == [LINE_LIMIT, LINE_LIMIT, 40963]


def test_a_prompt_that_has_no_newline(tmp_path: Path) -> None:
    """It has left the pipe, where it would keep the runner busy, and journald does not have it."""
    fifo = tmp_path / "a.out"
    os.mkfifo(fifo)
    journal = SlowJournal()
    journal.room = 1 << 30
    runner = Runner(fifo, journal)
    runner.pipes.adopt("a", "stdout", runner.fd, HeldLines(fifo))
    os.write(runner.fd, b"ready\nEnter a number: ")
    runner.turn()
    readable, _, _ = select.select([runner.fd], [], [], 0)
    assert not readable
    runner.kill()
    assert messages(journal) == [b"ready"]
    assert replayed(fifo) == [b"Enter a number: "]


def test_no_file_and_a_torn_one(tmp_path: Path) -> None:
    fifo = tmp_path / "a.out"
    assert read_held(fifo) == (b"", 0)
    held_path(fifo).write_bytes(b"torn")
    assert read_held(fifo) == (b"", 0)


def test_a_kill_as_soon_as_it_is_read(fifo: Path) -> None:
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    os.write(fd, b"one\ntwo")
    assert HeldLines(fifo).take(fd, 1000) == b"one\ntwo"
    assert read_held(fifo) == (b"one\ntwo", 0)


def test_the_file_does_not_grow(fifo: Path) -> None:
    """Lines that end in the next chunk only, again and again."""
    journal = SlowJournal()
    journal.room = 1 << 30
    runner = Runner(fifo, journal)
    runner.pipes.adopt("a", "stdout", runner.fd, HeldLines(fifo))
    for _ in range(1000):
        os.write(runner.fd, b"x" * 5000 + b"\n" + b"rest")
        runner.turn()
    assert held_path(fifo).stat().st_size < 2 * LINE_LIMIT
    runner.kill()
    assert len(messages(journal)) == 1000
    assert replayed(fifo) == [b"rest"]
    assert [path.name for path in fifo.parent.iterdir() if path.suffix != ".out"] == ["a.out.held"]


def test_a_full_disk_is_no_reason_to_stop(fifo: Path) -> None:
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    held = HeldLines(fifo)
    os.close(held._fd)
    held._fd = os.open("/dev/full", os.O_RDWR)
    os.write(fd, b"line\n")
    assert held.take(fd, 100) == b"line\n"
    held.add(b"\n")
    held.sent(1)
    held.sent_all(1, b"rest")
    assert read_held(fifo) == (b"rest", 0)
    held.close()


def test_no_file_for_what_is_held_loses_no_line(tmp_path: Path) -> None:
    """As where the file system has no inode left: only a kill of the runner needs the file."""
    reading, writing = os.pipe2(os.O_NONBLOCK)
    held = HeldLines(tmp_path / "gone/a.out")
    for data, rest in ((b"one\n", b""), (b"two", b"two"), (b"\n", b"")):
        os.write(writing, data)
        assert held.take(reading, 100) == data
        held.add(b"x")
        held.sent(0)
        held.sent_all(1, rest)
    held.close()
    held.close()
    os.close(reading)
    os.close(writing)


@contextmanager
def full_disk(size: int = 0) -> Iterator[None]:
    """No file of this process can grow above so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("rest", [b"", b"half"])
def test_a_disk_that_is_full_and_has_room_again(rest: bytes, fifo: Path) -> None:
    """No line is lost meanwhile, and from then on a kill of the runner loses none."""
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    with full_disk():
        held = HeldLines(fifo)
        os.write(fd, b"one\ntwo")
        assert held.take(fd, 100) == b"one\ntwo"
        held.add(b"\n")
        held.sent(1)
        held.sent_all(1, b"two")
    os.write(fd, b"\nthree\n")
    assert held.take(fd, 100) == b"\nthree\n"
    assert read_held(fifo) == (b"", 0), "it lacks the begin of a line"
    held.sent_all(2, rest)
    os.write(fd, b"four\n")
    assert held.take(fd, 100) == b"four\n"
    assert read_held(fifo) == (rest + b"four\n", 0)
    held.close()
    held.sent_all(1, b"")
    os.close(fd)
    assert read_held(fifo) == (rest + b"four\n", 0), "a killed runner leaves its file"


def test_a_disk_that_is_full_in_the_middle_of_a_write(fifo: Path) -> None:
    held = HeldLines(fifo)
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    with full_disk(12):
        os.write(fd, b"long line")
        assert held.take(fd, 100) == b"long line"[:4]
        assert held.take(fd, 100) == b"long line"[4:]
        held.sent_all(0, b"long line")
        assert read_held(fifo) == (b"", 0), "rather nothing than a part of it"
    held.sent_all(0, b"long line")
    assert read_held(fifo) == (b"long line", 0)
    held.close()
    os.close(fd)
