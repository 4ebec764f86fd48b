"""Bytes to and from a child that takes nothing, says nothing or ends."""

import os
import socket
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import pytest

from dora_systemd.trust.pipes import receive, send


class Pipe(NamedTuple):
    """The two ends of a pipe."""

    reading: int
    writing: int


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    one = Pipe(*os.pipe())
    yield one
    for fd in one:
        os.close(fd)


def soon(seconds: float = 20.0) -> float:
    return time.monotonic() + seconds


def test_all_of_it_arrives(pipe: Pipe) -> None:
    """Also what is more than a pipe holds, and more than one read gets."""
    data = os.urandom(300_000)
    sender = threading.Thread(target=send, args=(pipe.writing, data + b"rest", soon()))
    sender.start()
    assert receive(pipe.reading, len(data), soon()) == data
    assert receive(pipe.reading, 4, soon()) == b"rest"
    sender.join()


def test_nothing_is_nothing(pipe: Pipe) -> None:
    send(pipe.writing, b"", soon(-1))
    assert receive(pipe.reading, 0, soon(-1)) == b""


def test_what_is_there_needs_no_time(pipe: Pipe) -> None:
    send(pipe.writing, b"word", soon(-1))
    assert receive(pipe.reading, 4, soon(-1)) == b"word"


def test_who_takes_nothing_is_not_waited_for(pipe: Pipe) -> None:
    with pytest.raises(BrokenPipeError):
        send(pipe.writing, bytes(1_000_000), soon(0.05))


@pytest.mark.parametrize("said", [b"", b"wor"])
def test_who_says_too_little_is_not_waited_for(pipe: Pipe, said: bytes) -> None:
    os.write(pipe.writing, said)
    with pytest.raises(BrokenPipeError):
        receive(pipe.reading, 4, soon(0.05))


def test_who_ends_has_said_all() -> None:
    reading, writing = os.pipe()
    os.write(writing, b"wor")
    os.close(writing)
    with pytest.raises(BrokenPipeError):
        receive(reading, 4, soon())
    os.close(reading)


def test_who_can_be_written_to_has_said_nothing() -> None:
    """A socket is ready for one direction, and not for the other."""
    own, other = socket.socketpair()
    with own, other:
        with pytest.raises(BrokenPipeError):
            receive(own.fileno(), 1, soon(0.05))
        own.setblocking(False)
        with pytest.raises(BlockingIOError):
            while True:
                own.send(bytes(65536))
        other.send(b"x")
        with pytest.raises(BrokenPipeError):
            send(own.fileno(), b"y", soon(0.05))
