"""The ring: what is written is read, within the budget, whenever the writer is killed."""

import json
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.recorder.reading import Reading, Recorded
from dora_systemd.decisions.recorder.ring import (
    ALIGN,
    HEADER,
    MAGIC,
    SMALL,
    Header,
    State,
    format_header,
    format_state,
    parse_header,
    read_state,
    span_of,
    state_at,
    tape_at,
)
from dora_systemd.decisions.recorder.writer import Writer
from tests.unit.fakes.recorder.ring import (
    PAGE,
    SECOND,
    MemoryStore,
    message,
    ring,
    start_of_tapes,
    writer,
)

BIG = 1 << 30


def read(store: MemoryStore, most: int = BIG) -> tuple[list[Recorded], Reading]:
    reading = Reading(store, store.size, most)
    return list(reading.messages()), reading


def datas(store: MemoryStore, output: int = 0) -> list[bytes]:
    return [one.data for one in read(store)[0] if one.output == output]


def test_what_is_written_is_read_in_its_order() -> None:
    store, header = ring()
    one = writer(store)
    one.put(0, message(b"first", 10))
    one.put(1, message(b"second", 20, b"other"), dropped=3)
    one.put(0, message(b"third", 30))
    messages, reading = read(store)
    assert [(m.output, m.schema, m.meta, m.data) for m in messages] == [
        (0, b"schema", b"{}", b"first"),
        (1, b"other", b"{}", b"second"),
        (0, b"schema", b"{}", b"third"),
    ]
    assert [m.head[2:5] for m in messages] == [(11, 10, 12), (21, 20, 22), (31, 30, 32)]
    assert [(one.received, one.dropped) for one in reading.states] == [(2, 0), (1, 3)]
    assert (reading.header, reading.damaged, reading.is_cut) == (header, 0, False)


def test_a_changed_schema_is_that_of_its_message() -> None:
    store, _ = ring(budget=64 * PAGE)
    one = writer(store)
    for schema in (b"a", b"b" * 70_000, b"a"):
        one.put(0, message(b"x", schema=schema))
    assert [m.schema for m in read(store)[0]] == [b"a", b"b" * 70_000, b"a"]
    store, _ = ring()
    writer(store).put(0, message(b"x", schema=b"b" * 65_000))
    assert [m.schema[:2] for m in read(store)[0]] == [b"bb"]


def test_bytes_win_over_seconds_and_one_output_does_not_evict_another() -> None:
    store, _ = ring(budget=16 * PAGE)
    one = writer(store)
    for at in range(10):
        one.put(1, message(b"state %d" % at, at))
    for at in range(50):
        one.put(0, message(bytes([at]) * 5000, at))
    assert len(datas(store, 1)) == 10, "the small output keeps all"
    assert [data[0] for data in datas(store, 0)][-1] == 49
    state = read(store)[1].states[0]
    assert state.received == 50 == state.evicted + len(datas(store, 0))


def test_seconds_win_where_there_is_room() -> None:
    store, _ = ring(last=5 * SECOND)
    one = writer(store)
    for at in range(20):
        one.put(0, message(bytes([at]), at * SECOND))
    assert [data[0] for data in datas(store)] == [14, 15, 16, 17, 18, 19]
    assert read(store)[1].states[0].evicted == 0, "they were old"


def test_the_last_message_of_each_output_stays() -> None:
    store, _ = ring(budget=16 * PAGE, last=SECOND)
    one = writer(store)
    one.put(1, message(b"long ago", 0))
    for at in range(50):
        one.put(0, message(bytes(20_000), at * SECOND))
    assert datas(store, 1) == [b"long ago"]


def test_a_message_for_which_the_budget_is_too_small_is_counted() -> None:
    store, _ = ring(budget=4 * PAGE)
    one = writer(store)
    one.put(0, message(b"small"))
    one.put(0, message(bytes(5 * PAGE)))
    one.put(0, message(bytes(6 * PAGE)))
    one.put(0, message(b"small again"))
    assert datas(store) == [b"small", b"small again"]
    state = read(store)[1].states[0]
    assert (state.received, state.too_large, state.largest) == (4, 2, 6 * PAGE)


def test_of_large_messages_only_the_last_stays_unless_asked_for() -> None:
    for only_small, expected in ((True, 1), (False, 3)):
        store, _ = ring(budget=80 * PAGE, only_small=only_small)
        one = writer(store)
        for _ in range(3):
            one.put(0, message(bytes(SMALL + 1)))
        assert len(datas(store)) == expected


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 20_000)), max_size=40))
def test_the_budget_holds(messages: list[tuple[int, int]]) -> None:
    budget = 8 * PAGE
    store, header = ring(budget, outputs=3)
    one = writer(store)
    last: dict[int, bytes] = {}
    for number, (output, size) in enumerate(messages):
        data = number.to_bytes(4, "little") + bytes(size)
        before = read_state(store, output)[0].too_large
        one.put(output, message(data, number))
        if read_state(store, output)[0].too_large == before:
            last[output] = data
        assert store.used_from(start_of_tapes(header)) <= one.used <= budget
    for output, data in last.items():
        assert datas(store, output)[-1] == data


@given(
    st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9_000)), min_size=1, max_size=25),
    st.integers(0, 120_000),
)
def test_a_writer_that_is_killed_loses_one_message_at_most(
    messages: list[tuple[int, int]], left: int
) -> None:
    store, header = ring(budget=8 * PAGE)
    one, done, killed = writer(store), list[bytes](), -1
    store.left = left
    try:
        for number, (output, size) in enumerate(messages):
            killed = output
            one.put(output, message(number.to_bytes(4, "little") + bytes(size), number))
            done.append(number.to_bytes(4, "little"))
    except KeyboardInterrupt:
        pass
    store.left = -1
    messages_read, reading = read(store)
    assert reading.damaged == 0
    numbers = [m.data[:4] for m in messages_read]
    assert not done or numbers[-1] >= done[-1]
    again = writer(store)
    assert store.used_from(start_of_tapes(header)) <= again.used, "no page is lost"
    again.put(max(killed, 0), message(b"after the kill", 1000))
    assert read(store)[0][-1].data == b"after the kill"


@given(st.data())
def test_a_ring_that_anybody_has_changed_is_read_within_bounds(data: st.DataObject) -> None:
    store, header = ring(budget=8 * PAGE)
    one = writer(store)
    for number in range(6):
        one.put(number % 2, message(bytes(3000), number))
    places = [0, state_at(0), state_at(1), tape_at(header, 0), tape_at(header, 1)]
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.sampled_from(places)) + data.draw(st.integers(0, 400))
        store.write(place, [data.draw(st.binary(min_size=1, max_size=16))])
    try:
        messages, _ = read(store, 20_000)
    except ValueError:
        return
    assert sum(m.head.size for m in messages) <= 2 * 20_000
    writer(store).put(0, message(b"and it goes on"))
    assert datas(store)[-1] == b"and it goes on"


def test_a_reader_reads_no_more_than_it_was_told() -> None:
    store, _ = ring()
    one = writer(store)
    for _ in range(5):
        one.put(0, message(bytes(1000)))
    messages, reading = read(store, 2500)
    assert [m.head.number for m in messages] == [4, 5], "the newest"
    assert reading.is_cut


def test_of_each_output_the_last_message_is_read_though_it_is_old() -> None:
    store, _ = ring()
    one = writer(store)
    one.put(1, message(b"long ago"))
    for _ in range(5):
        one.put(0, message(bytes(1000)))
    messages, _ = read(store, 2500)
    assert [m.head.number for m in messages] == [5, 6, 1]


def test_a_ring_that_claims_more_than_its_budget() -> None:
    store, header = ring(budget=8 * PAGE)
    writer(store)
    for at in range(2):
        state = State(head=header.budget - 8, version=9)
        store.write(state_at(at), [format_state(state, b"")])
    with pytest.raises(ValueError, match="more than its budget"):
        read(store)


def test_a_damaged_message_is_counted() -> None:
    store, header = ring()
    one = writer(store)
    for _ in range(3):
        one.put(0, message(bytes(1000)))
    store.write(tape_at(header, 0) + 1500, [b"x"])
    messages, reading = read(store)
    assert (len(messages), reading.damaged) == (2, 1)


class Counting(MemoryStore):
    """Counts the reads."""

    reads = 0

    def read(self, at: int, size: int) -> bytes:
        self.reads += 1
        return super().read(at, size)


@pytest.mark.parametrize(("records", "most"), [(1000, 400), (20, 120)])
def test_damaged_messages_are_not_read_again_and_again(records: int, most: int) -> None:
    """The user of the nodes can write millions of them."""
    store, _ = ring(budget=64 * PAGE)
    one = writer(store)
    for _ in range(60):
        one.put(0, message(b"x"))
    for data in store.pages.values():
        data[:] = data.replace(b"x", b"y")
    store.__class__ = Counting
    assert isinstance(store, Counting)
    reading = Reading(store, store.size, 1 << 20, records)
    assert [*reading.messages()] == []
    assert store.reads < most


def test_of_a_large_message_both_ends_are_checked() -> None:
    for place, is_damaged in ((1000, True), (SMALL, False), (2 * SMALL - 1000, True)):
        store, header = ring(budget=64 * PAGE)
        writer(store).put(0, message(bytes(2 * SMALL)))
        store.write(tape_at(header, 0) + place, [b"x"])
        messages, reading = read(store)
        assert (len(messages), reading.damaged) == (1 - is_damaged, is_damaged)


class Moving(MemoryStore):
    """A recorder that writes on while the ring is read: `more` messages of `size` bytes."""

    more = size_of_more = 0
    writer: Writer

    def read(self, at: int, size: int) -> bytes:
        if self.more and size == self.size_of_more + len(b"{}"):
            early, quarter = super().read(at, size), size // 4
            while self.more:
                self.more -= 1
                one = message(bytes([self.more]) * self.size_of_more, 100 + self.more)
                self.writer.put(0, one)
            late = super().read(at, size)
            return early[:quarter] + late[quarter:-quarter] + early[-quarter:]
        return super().read(at, size)


@pytest.mark.parametrize("size", [5000, 2 * SMALL])
def test_a_ring_that_is_written_meanwhile_has_the_last_message_of_each_output(size: int) -> None:
    store, _ = ring(budget=2 * size + 2 * PAGE)
    store.__class__ = Moving
    assert isinstance(store, Moving)
    store.writer, store.size_of_more = writer(store), size
    store.writer.put(0, message(bytes([9]) * size))
    store.more = 3
    messages, reading = read(store)
    assert [one.data for one in messages] == [bytes(size)]
    assert datas(store)[-1] == bytes(size)
    assert reading.damaged == 0


def test_the_header_is_read_back_and_others_are_refused() -> None:
    header = Header(["a/b"], span_of(PAGE), PAGE, 5, True, {"dataflow": "arm"})
    data = format_header(header)
    assert parse_header(data + bytes(100)) == header
    deep = "[" * 50_000
    numbers = MAGIC, 1, 1, span_of(PAGE), PAGE, len(deep)
    crc = zlib.crc32(HEADER.pack(*numbers, 0) + deep.encode())
    for bad in (
        *(b"", data[:20], data[:-1], b"X" + data[1:], data[:40] + b"?" + data[41:]),
        HEADER.pack(*numbers, crc) + deep.encode(),
    ):
        with pytest.raises(ValueError, match=r"it|its"):
            parse_header(bad)
    with pytest.raises(ValueError, match="too many"):
        format_header(header._replace(outputs=["a/b"] * 300))
    assert len(json.dumps(["a/b"])) < ALIGN
    with pytest.raises(ValueError, match="does not fit"):
        Reading(ring()[0], 5, BIG)


def test_the_last_message_of_one_output() -> None:
    store, _ = ring()
    one = writer(store)
    for at in range(3):
        one.put(0, message(b"x", at))
    reading = Reading(store, store.size, 1 << 20)
    last = reading.newest(0, 3)
    assert last is not None
    assert (last.head.number, last.data) == (3, b"x")
    assert reading.newest(0, 2) is None, "it has more messages than are searched"
    assert reading.newest(1) is None
    assert (reading.metadata(0), reading.metadata(1)) == (b"{}", b"")
    assert Reading(store, store.size, 1).metadata(0) == b""
