"""One side of the talk between two machines."""

import asyncio

from dora_systemd.decisions.machines.wire import (
    LEASE_SECONDS,
    MAX_LINE,
    Beat,
    Message,
    StopPart,
    Table,
)
from dora_systemd.runner.machines.lines import Lines
from tests.unit.fakes.ends import FakeEnds
from tests.unit.fakes.loop import live


def test_it_passes_what_comes_until_the_end() -> None:
    async def work() -> None:
        other, heard = FakeEnds(), list[Message]()
        other.say(Beat(), StopPart(5))
        other.reader.feed_eof()
        assert await Lines(other.ends).talk(heard.append) == "the connection has ended"
        assert heard == [Beat(), StopPart(5)]
        assert other.writer.is_closed

    live(work)


def test_silence_ends_it_after_the_lease() -> None:
    async def work() -> None:
        other, beats = FakeEnds(), list[int]()
        begun = asyncio.get_running_loop().time()
        why = await Lines(other.ends, lambda: beats.append(1)).talk(lambda _: None)
        assert why == "no word for 7s"
        assert asyncio.get_running_loop().time() - begun == LEASE_SECONDS
        assert other.heard(without="") == [{"type": "beat"}] * 7
        assert len(beats) == 7

    live(work)


def test_one_that_speaks_lives() -> None:
    async def work() -> None:
        other = FakeEnds()
        lines = Lines(other.ends)
        talk = asyncio.create_task(lines.talk(lambda _: None))
        for _ in range(20):
            await asyncio.sleep(1)
            other.say(Beat())
            await asyncio.sleep(0)
        assert not talk.done()
        assert lines.silent <= 1
        other.reader.feed_eof()
        await talk

    live(work)


def test_what_is_no_line_of_ours_ends_it() -> None:
    async def work() -> None:
        for said, why in (
            (b"{}\n", "cannot read what the other machine says"),
            (b"x" * 3000 + b"\n", "a line is too long"),
        ):
            other = FakeEnds()
            other.reader.feed_data(said)
            assert await Lines(other.ends).talk(lambda _: None) == why

    live(work)


def test_a_flood_ends_it() -> None:
    async def work() -> None:
        other, heard = FakeEnds(), list[Message]()
        other.say(*[Beat()] * 1000)
        assert await Lines(other.ends).talk(heard.append) == "the other side says too much"
        assert len(heard) == 200

    live(work)


def test_a_flood_of_long_lines_ends_it() -> None:
    async def work() -> None:
        other, heard = FakeEnds(limit=MAX_LINE), list[Message]()
        other.say(*[Table("x" * (MAX_LINE - 1000))] * 20)
        assert await Lines(other.ends).talk(heard.append) == "the other side says too much"
        assert len(heard) < 10

    live(work)


def test_words_that_nobody_can_handle_end_it() -> None:
    """Else a lost machine would count as there."""

    def hear(_: Message) -> None:
        raise AttributeError("no such thing")

    async def work() -> None:
        other = FakeEnds()
        other.say(Beat())
        why = await Lines(other.ends).talk(hear)
        assert why == "what it says cannot be handled: AttributeError"
        assert other.writer.is_closed

    live(work)


def test_one_that_does_not_read_is_not_waited_for() -> None:
    async def work() -> None:
        other = FakeEnds()
        other.writer.unsent = 1 << 30
        assert await Lines(other.ends).talk(lambda _: None) == "the other side does not read"
        Lines(other.ends).send(Beat())  # and nothing more is written

    live(work)
