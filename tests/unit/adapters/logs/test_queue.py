"""The order of entries when journald takes them late."""

import asyncio
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.logs.queue import MAX_RECORDS, NOTE_EVERY, LogQueue


class SlowJournal:
    """A journal that takes as many entries as it has been given room for."""

    def __init__(self) -> None:
        self.room = 0
        self.taken: list[bytes] = []
        self.refused = False
        self.callback: Callable[[], None] | None = None

    def send(self, entry: bytes) -> bool:
        if not self.room:
            self.refused = True
            return False
        self.room -= 1
        self.taken.append(entry)
        return True

    send_bulk = send

    def call_when_ready(self, _: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        self.callback = callback

    def wait_ready(self, seconds: float) -> None:
        del seconds

    def make_room(self, room: int) -> None:
        self.room = room
        if self.refused and self.callback:
            self.refused = False
            self.callback()


class Case:
    def __init__(self, loop: asyncio.AbstractEventLoop, max_records: int = MAX_RECORDS) -> None:
        self.journal = SlowJournal()
        self.paused: set[str] = set()
        pause, resume = self.paused.add, self.paused.discard
        self.queue = LogQueue(loop, self.journal, pause, resume, max_records)

    def put(self, node: str, entries: list[bytes]) -> None:
        self.queue.put(node, lambda: entries)


@pytest.fixture
def case(loop: asyncio.AbstractEventLoop) -> Case:
    return Case(loop)


def test_taken_at_once(case: Case) -> None:
    case.journal.room = 3
    case.put("a", [b"1", b"2"])
    case.queue.put_event(b"e")
    assert case.journal.taken == [b"1", b"2", b"e"]
    assert case.queue.is_empty
    assert not case.paused


def test_node_is_paused_until_its_lines_are_taken(case: Case) -> None:
    case.put("a", [b"1", b"2"])
    case.put("b", [b"3"])
    assert case.paused == {"a", "b"}
    case.journal.make_room(2)
    assert len(case.journal.taken) == 2
    assert case.paused
    case.journal.make_room(9)
    assert not case.paused
    assert case.queue.is_empty


def test_what_is_taken_is_noted_soon(case: Case) -> None:
    """Or a runner that is killed in a flood would have all of it written again."""
    noted: list[int] = []
    case.journal.make_room(NOTE_EVERY * 2 + 3)
    entries = [b"%d" % number for number in range(NOTE_EVERY * 3)]
    case.queue.put("a", lambda: entries, note=noted.append)
    assert noted == [NOTE_EVERY * 2, NOTE_EVERY, NOTE_EVERY - 3]
    case.journal.make_room(NOTE_EVERY)
    assert noted[3:] == [0]


def test_event_comes_after_all_before_it(case: Case) -> None:
    case.put("a", [b"a1", b"a2"])
    case.queue.put_event(b"end")
    case.put("b", [b"b1"])
    case.queue.put_record("a", b"a3")
    for _ in range(5):
        case.journal.make_room(1)
    assert sorted(case.journal.taken) == [b"a1", b"a2", b"a3", b"b1", b"end"]
    assert case.journal.taken.index(b"end") > case.journal.taken.index(b"a2")


def test_records_are_bounded_and_counted(loop: asyncio.AbstractEventLoop) -> None:
    case = Case(loop, max_records=3)
    for _ in range(5):
        case.queue.put_record("a", b"x")
        case.queue.put_event(b"e")
    assert case.queue.waiting("a") == 3
    assert case.queue.take_lost() == 4
    assert case.queue.take_lost() == 0
    assert case.queue.give_up() == 6
    assert case.queue.is_empty


STEPS = st.lists(
    st.tuples(st.just("put"), st.sampled_from("abc"), st.integers(1, 4))
    | st.tuples(st.just("event"), st.just(""), st.just(0))
    | st.tuples(st.just("room"), st.just(""), st.integers(0, 5)),
    max_size=40,
)


@given(STEPS)
def test_any_history(steps: list[tuple[str, str, int]]) -> None:
    loop = asyncio.new_event_loop()
    loop.close()
    case = Case(loop)
    put: list[bytes] = []
    for step, node, count in steps:
        if step == "put":
            entries = [b"%s%d" % (node.encode(), len(put) + i) for i in range(count)]
            case.put(node, entries)
            put += entries
        elif step == "event":
            put.append(b"!%d" % len(put))
            case.queue.put_event(put[-1])
        else:
            case.journal.make_room(count)
    while not case.queue.is_empty:
        case.journal.make_room(3)
    taken = case.journal.taken
    assert sorted(taken) == sorted(put)
    for kind in (b"a", b"b", b"c", b"!"):
        assert [e for e in taken if e[:1] == kind] == [e for e in put if e[:1] == kind]
    for event in (entry for entry in put if entry[:1] == b"!"):
        before = put[: put.index(event)]
        assert set(before) <= set(taken[: taken.index(event)])
    assert not case.paused


def test_lanes_take_turns(case: Case) -> None:
    """Or the first one would have all the room that comes."""
    for node in "abc":
        case.put(node, [node.encode()] * 9)
    for _ in range(4):
        case.journal.make_room(1)
    assert case.journal.taken == [b"a", b"b", b"c", b"a"]


class Separate(SlowJournal):
    """Leaves the last place to entries that are of no flood."""

    def send_bulk(self, entry: bytes) -> bool:
        return self.room > 1 and self.send(entry)


def test_a_flood_leaves_room_for_others(loop: asyncio.AbstractEventLoop) -> None:
    journal = Separate()
    journal.room = 3
    queue = LogQueue(loop, journal, lambda _: None, lambda _: None)
    queue.put("flood", lambda: [b"1", b"2", b"3"], is_flood=True)
    queue.put("quiet", lambda: [b"q"])
    assert journal.taken == [b"1", b"2", b"q"]
    assert (queue.waiting("flood"), queue.waiting("quiet")) == (1, 0)


def test_a_lane_without_records_takes_as_many_again(loop: asyncio.AbstractEventLoop) -> None:
    case = Case(loop, max_records=2)
    for _ in range(3):
        case.queue.put_record("a", b"x")
    case.journal.make_room(9)
    assert case.queue.take_lost() == 1
    case.journal.room = 0
    for _ in range(3):
        case.queue.put_record("a", b"x")
    assert (case.queue.take_lost(), case.queue.waiting("a")) == (1, 2)


def test_what_is_given_up_is_counted(case: Case) -> None:
    case.journal.room = 1
    case.put("a", [b"1", b"2", b"3"])
    case.put("a", [b"4", b"5"])
    case.put("b", [b"6"])
    case.queue.put_event(b"e")
    assert not case.queue.is_empty
    assert case.queue.give_up() == 6
    assert (case.queue.give_up(), case.queue.is_empty) == (0, True)
    assert case.journal.taken == [b"1"]


def test_an_event_that_is_refused_is_sent_later(case: Case) -> None:
    for entry in (b"1", b"2"):
        case.queue.put_event(entry)
    assert not case.queue.is_empty
    case.journal.make_room(1)
    assert case.journal.taken == [b"1"]
    case.journal.make_room(1)
    assert case.journal.taken == [b"1", b"2"]
    assert case.queue.is_empty
