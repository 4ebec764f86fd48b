"""What a member hears before it runs anything, by pipes in the place of ssh."""

import os
from collections.abc import Iterator

import pytest

from dora_systemd.decisions.machines.wire import Beat, Part, Ready, format_message, parse_message
from dora_systemd.errors import DoraSystemdError
from dora_systemd.verbs.machines import head as module
from dora_systemd.verbs.machines.head import Head
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
def test_a_head_that_says_something_else(
    pipes: tuple[int, int, int, int], said: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, far_write, _, writing = pipes
    monkeypatch.setattr(module, "PART_SECONDS", 0.2)
    monkeypatch.setattr(module, "MAX_LINE", 1000)
    os.write(far_write, said[:60_000])
    with pytest.raises(DoraSystemdError):
        Head(reading, writing).part()


def test_a_head_that_only_beats(
    pipes: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, far_write, _, writing = pipes
    monkeypatch.setattr(module, "_MOST_SECONDS", 0.2)
    os.write(far_write, format_message(Beat()) * 3)
    with pytest.raises(DoraSystemdError, match="no head says what to run"):
        Head(reading, writing).part()
