"""One node: when its pipe floods, what is kept of its lines, and what is counted."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.adapters.logs.held import HeldLines, read_held
from dora_systemd.adapters.logs.source import CHUNK, FLOOD_BYTES, Pipe, Source, fifos
from dora_systemd.decisions.cell.line_rates import LineLimiter, RateLimit
from dora_systemd.decisions.logs.lines import LineEncoder, Origin
from dora_systemd.paths import CellPaths
from dora_systemd.values import SECOND

ORIGIN = Origin("robot", "u", "camera")


@pytest.fixture
def pipe(fifo: Path) -> Iterator[Pipe]:
    fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    found = Pipe(fd, "stdout", LineEncoder(ORIGIN, "stdout"), held=HeldLines(fifo))
    yield found
    found.close()


@pytest.fixture
def source(pipe: Pipe) -> Source:
    return Source(ORIGIN, [pipe])


def write(pipe: Pipe, data: bytes) -> bytes:
    """Write to it, and read it."""
    os.write(pipe.fd, data)
    return pipe.read()


def texts(entries: list[bytes]) -> list[bytes]:
    return [one.split(b"MESSAGE=")[1][:-1] for one in entries]


def test_one_read_is_a_chunk(pipe: Pipe) -> None:
    assert pipe.read() == b""
    assert len(write(pipe, b"x" * (CHUNK + 1))) == CHUNK
    assert pipe.read() == b"x"


@pytest.mark.parametrize(
    ("reads", "is_flood"),
    [
        ([(1.0, FLOOD_BYTES)], [False]),
        ([(1.0, FLOOD_BYTES + 1)], [True]),
        ([(1.0, FLOOD_BYTES), (1.09, 1)], [False, True]),
        ([(1.0, FLOOD_BYTES), (1.11, FLOOD_BYTES)], [False, False]),
        ([(1.0, FLOOD_BYTES), (1.11, 1), (1.2, FLOOD_BYTES)], [False, False, True]),
    ],
)
def test_what_is_a_flood(pipe: Pipe, reads: list[tuple[float, int]], is_flood: list[bool]) -> None:
    assert [pipe.is_flood(size, now) for now, size in reads] == is_flood


def test_what_journald_lacks_is_held(source: Source, pipe: Pipe, fifo: Path) -> None:
    first = source.batch(pipe, write(pipe, b"1\n2\n3"), 0.0)
    assert texts(first.entries()) == [b"1", b"2"]
    first.note(1)
    assert read_held(fifo) == (b"1\n2\n3", 1)
    assert source.written == 0
    second = source.batch(pipe, write(pipe, b"4\n5\n"), 0.0)
    first.note(0)
    assert read_held(fifo) == (b"1\n2\n34\n5\n", 2)
    assert texts(second.entries()) == [b"34", b"5"]
    second.note(1)
    assert read_held(fifo)[1] == 3
    second.note(0)
    assert read_held(fifo) == (b"", 0)
    assert source.written == 4


def test_the_end_of_an_unterminated_line_is_held(source: Source, pipe: Pipe, fifo: Path) -> None:
    source.batch(pipe, write(pipe, b"1"), 0.0).entries()
    end = source.batch(pipe, b"", 0.0)
    assert read_held(fifo)[0] == b"1\n"
    assert texts(end.entries()) == [b"1"]
    source.batch(pipe, b"", 0.0)
    assert read_held(fifo)[0] == b"1\n", "a line ends once"
    source.batch(pipe, write(pipe, b"2\n33\n"), 0.0)
    source.batch(pipe, b"", 0.0)
    assert read_held(fifo)[0] == b"1\n2\n33\n", "there is no open line"


def test_lines_above_the_limit_are_neither_written_nor_kept(
    source: Source, pipe: Pipe, fifo: Path
) -> None:
    assert (source.limit, source.take_suppressed()) == (None, 0)
    assert source.admit("stdout", 7, 0.0) == 7
    source.limiter = LineLimiter(RateLimit(2, SECOND))
    assert source.limit == RateLimit(2, SECOND)
    batch = source.batch(pipe, write(pipe, b"1\n2\n3\n"), 0.0)
    assert (batch.suppressed, texts(batch.entries())) == (1, [b"1", b"2"])
    batch.note(0)
    assert (source.written, source.suppressed) == (2, 0)
    assert (source.take_suppressed(), source.suppressed) == (1, 1)
    assert read_held(fifo) == (b"", 0)
    later = source.batch(pipe, write(pipe, b"4\n"), 0.9)
    assert later.entries() == []
    assert texts(source.batch(pipe, write(pipe, b"5\n"), 1.0).entries()) == [b"5"]


def test_who_has_written_what_was_read_before(source: Source, pipe: Pipe) -> None:
    """A new process of the node changes nothing of the lines of the last one."""
    before = source.batch(pipe, b"1\n", 0.0)
    source.renew(pid=42, run="r")
    after = source.batch(pipe, b"2\n", 0.0)
    assert b"DORA_NODE_PID" not in before.entries()[0]
    assert b"\nDORA_NODE_PID=42\nDORA_RUN=r\nDORA_STREAM=stdout\n" in after.entries()[0]


def test_the_pipes_of_a_node(tmp_path: Path) -> None:
    paths = CellPaths(tmp_path)
    assert fifos("a", paths) == {
        "stdout": paths.node_stdout("a"),
        "stderr": paths.node_stderr("a"),
    }


def open_files() -> int:
    return len([*Path("/dev/fd").iterdir()])


def test_to_close_a_pipe_closes_what_it_holds(fifo: Path) -> None:
    """Or each restart of a node would leave open files, until none can be opened."""
    before = open_files()
    for held in (HeldLines(fifo), None):
        fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
        Pipe(fd, "stdout", LineEncoder(ORIGIN, "stdout"), held=held).close()
    assert open_files() == before
