"""The way into journald, against a socket of our own."""

import array
import asyncio
import errno
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.adapters.journal.socket import JournalSocket


class Journald:
    """The receiving end: a datagram socket that may go away and come back."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start()

    def start(self) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.socket.bind(str(self.path))

    def stop(self) -> None:
        self.socket.close()
        self.path.unlink(missing_ok=True)

    def receive(self) -> bytes | None:
        """The next entry, by datagram or by memfd; None if there is none."""
        size = array.array("i").itemsize
        try:
            data, ancillary, _, _ = self.socket.recvmsg(1 << 20, socket.CMSG_SPACE(size))
        except BlockingIOError:
            return None
        for _, _, content in ancillary:
            fd = array.array("i", content)[0]
            with os.fdopen(fd, "rb") as file:
                file.seek(0)
                return file.read()
        return data

    def all(self) -> list[bytes]:
        found = []
        while (entry := self.receive()) is not None:
            found.append(entry)
        return found


@pytest.fixture
def journald(tmp_path: Path) -> Iterator[Journald]:
    server = Journald(tmp_path / "socket")
    yield server
    server.stop()


@pytest.fixture
def journal(journald: Journald) -> Iterator[JournalSocket]:
    client = JournalSocket(str(journald.path))
    yield client
    client.close()


def fill(journal: JournalSocket) -> list[bytes]:
    """Send until the socket is full; what it has taken."""
    taken: list[bytes] = []
    while journal.send_bulk(entry := b"N=%d\n" % len(taken)):
        taken.append(entry)
        assert len(taken) < 10_000
    return taken


def test_entry(journal: JournalSocket, journald: Journald) -> None:
    assert journal.send(b"MESSAGE=a\n")
    assert journal.send_bulk(b"MESSAGE=b\n")
    assert journald.all() == [b"MESSAGE=a\n", b"MESSAGE=b\n"]


@pytest.mark.parametrize("size", [100_000, 1 << 20, 5 << 20])
def test_big_entry_goes_by_memfd(journal: JournalSocket, journald: Journald, size: int) -> None:
    entry = b"MESSAGE=" + b"x" * size + b"\n"
    assert journal.send(entry)
    assert journal.send_bulk(entry)
    assert journald.all() == [entry, entry]


def test_full(journal: JournalSocket, journald: Journald) -> None:
    taken = fill(journal)
    assert not journal.send_bulk(b"MESSAGE=" + b"x" * 100_000 + b"\n")
    assert journald.all() == taken
    assert journal.send_bulk(b"MESSAGE=after\n")


def test_journald_comes_back_at_once(journal: JournalSocket, journald: Journald) -> None:
    assert journal.send(b"A=1\n")
    journald.stop()
    journald.start()
    assert journal.send(b"A=2\n")
    assert journald.all() == [b"A=2\n"]


def test_journald_is_away(journal: JournalSocket, journald: Journald) -> None:
    assert journal.send(b"A=1\n")
    journald.stop()
    assert not journal.send(b"A=2\n")
    assert not journal.send_bulk(b"A=3\n")
    journald.start()
    assert journal.send(b"A=2\n")


def test_callback_when_there_is_room(journal: JournalSocket, journald: Journald) -> None:
    async def scenario() -> None:
        fill(journal)
        ready = asyncio.Event()
        journal.call_when_ready(asyncio.get_running_loop(), ready.set)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await ready.wait()
        journald.all()
        async with asyncio.timeout(1):
            await ready.wait()

    asyncio.run(scenario())


def test_callback_when_journald_is_back(journal: JournalSocket, journald: Journald) -> None:
    async def scenario() -> None:
        journald.stop()
        assert not journal.send(b"A=1\n")
        loop = asyncio.get_running_loop()
        loop.call_later(0.15, journald.start)
        done = asyncio.Event()

        def again() -> None:
            if journal.send(b"A=1\n"):
                done.set()
            else:
                journal.call_when_ready(loop, again)

        journal.call_when_ready(loop, again)
        async with asyncio.timeout(2):
            await done.wait()

    asyncio.run(scenario())
    assert journald.all() == [b"A=1\n"]


def test_callback_outlives_a_reconnection(journal: JournalSocket, journald: Journald) -> None:
    """Another entry's success after a restart must not make the one that waits forget."""

    async def scenario() -> None:
        fill(journal)
        ready = asyncio.Event()
        journal.call_when_ready(asyncio.get_running_loop(), ready.set)
        journald.stop()
        journald.start()
        assert journal.send_bulk(b"A=1\n")
        async with asyncio.timeout(1):
            await ready.wait()

    asyncio.run(scenario())


def test_wait_ready(journal: JournalSocket, journald: Journald) -> None:
    fill(journal)
    journal.wait_ready(0.05)
    assert not journal.send_bulk(b"A=1\n")
    journald.all()
    journal.wait_ready(5)
    assert journal.send_bulk(b"A=1\n")
    journald.stop()
    assert not journal.send(b"A=1\n")
    journal.wait_ready(0.05)


def test_waits_until_what_was_sent_is_read(journal: JournalSocket, journald: Journald) -> None:
    for entry in (b"MESSAGE=a\n", b"MESSAGE=b\n"):
        journal.send(entry)
    begun = time.monotonic()
    journal.wait_read(0.1)
    assert time.monotonic() - begun >= 0.1
    reader = threading.Timer(0.05, journald.all)
    reader.start()
    journal.wait_read(10)
    assert time.monotonic() - begun < 9
    reader.join()


def test_the_callback_comes_each_time(journal: JournalSocket, journald: Journald) -> None:
    """Until nothing is refused any more: it is given once."""

    async def scenario() -> None:
        calls: list[int] = []

        def again() -> None:
            calls.append(len(fill(journal)) if len(calls) < 3 else 0)

        journal.call_when_ready(asyncio.get_running_loop(), again)
        await asyncio.sleep(0.01)
        assert not calls, "nothing is refused yet"
        fill(journal)
        async with asyncio.timeout(60):
            while len(calls) < 4:
                journald.all()
                await asyncio.sleep(0)
        journald.all()
        await asyncio.sleep(0.01)
        assert len(calls) == 4

    asyncio.run(scenario())


def test_a_deadline_that_is_over_is_not_waited_for(journal: JournalSocket) -> None:
    fill(journal)
    waiting = threading.Thread(target=journal.wait_ready, args=(-0.0001,), daemon=True)
    waiting.start()
    waiting.join(30)
    assert not waiting.is_alive()


def test_no_file_descriptor_for_a_big_entry(
    journal: JournalSocket, journald: Journald, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    entry = b"MESSAGE=" + b"x" * (1 << 20) + b"\n"
    with monkeypatch.context() as patch:
        patch.setattr(os, "memfd_create", refuse)
        assert not journal.send(entry)
    assert journal.send(entry)
    assert journald.all() == [entry]
