"""What a member hears before it runs anything, by pipes in the place of ssh."""

import os
import time
from collections.abc import Iterator

import pytest

from dora_systemd.decisions.machines.wire import Beat, Part, Ready, format_message, parse_message
from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.machines.member import Head, read_line
from tests.unit.fakes.manager import UUID

PART = Part("robot", UUID, "gpu", "s3cret", 61001, 61003, "0" * 64, 5, "0.1.0", "1.1.0")


@pytest.fixture
def pipes() -> Iterator[tuple[int, int, int, int]]:
    ends = (*os.pipe(), *os.pipe())
    yield ends
    for fd in ends:
        os.close(fd)


def test_what_follows_the_part_is_left_to_the_relay(pipes: tuple[int, int, int, int]) -> None:
    reading, far_write, far_read, writing = pipes
    rest = format_message(Beat())
    os.write(far_write, format_message(Beat()) + format_message(PART) + rest)
    with Head(reading, writing) as head:
        assert head.part() == PART
        head.tell(Ready("/run/x"))
    assert os.read(reading, 1000) == rest
    heard = [parse_message(line) for line in os.read(far_read, 1000).splitlines()]
    assert heard[0] == Beat()
    assert Ready("/run/x") in heard


@pytest.mark.parametrize("said", [b"", b"hello\n", format_message(Ready("/x")), b"x" * 300_000])
def test_a_head_that_says_something_else(pipes: tuple[int, int, int, int], said: bytes) -> None:
    reading, far_write, _, writing = pipes
    os.write(far_write, said[:60_000])
    head = Head(reading, writing)
    head.line_seconds = 0.2
    with pytest.raises(DoraSystemdError):
        head.part()


def test_a_line_without_an_end_is_read_to_a_bound(pipes: tuple[int, int, int, int]) -> None:
    reading, far_write, _, _ = pipes
    os.write(far_write, b"x" * 3000)
    assert read_line(reading, time.monotonic() + 60, 1000) == b"x" * 1000


def test_a_head_that_only_beats(pipes: tuple[int, int, int, int]) -> None:
    reading, far_write, _, writing = pipes
    os.write(far_write, format_message(Beat()) * 3)
    head = Head(reading, writing)
    head.most_seconds = 0.2
    with pytest.raises(DoraSystemdError, match="no head says what to run"):
        head.part()
